"""A simulation spec: what is recorded under which conditions, checked before anything is computed."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.bands import NARROW_H, H, J
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.files.shipped import SIMULATIONS, named_file
from irlos_pipe.files.validation import absolute, parse_setting, read_overridden
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import Instrument, checked_instrument, located
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.effects import EFFECTS, effects_of
from irlos_pipe.simulate.effects.wavefront import reached_nm
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.recordings.files import DOUBLE, LOOP_HZ, Defocus, Planned
from irlos_pipe.simulate.recordings.keys import (
    FACILITY_KEYS,
    AberrationKeys,
    LensletKeys,
    RecordingKeys,
    Shared,
)
from irlos_pipe.simulate.scene import Sampling, Scene, draw_ncpa_nm, draw_tail_nm
from irlos_pipe.simulate.telescope import sum_nm

BANDS = {
    "narrow_h": (Band.of(NARROW_H),),
    "j": (Band.of(J),),
    "h": (Band.of(H),),
    "j_h": (Band.of(J, 0.5), Band.of(H, 0.5)),
}
STANDARD = "irlos"  # profile without a word of one, which no side-car states
PRESENT = "2024-02-11"  # day of recordings whose start is not given
SETTING_EXAMPLE = "KEY=VALUE, for example recordings.calibration.frames=20"
WHOLE = {"ncpa", "rotating"}  # replaced as a whole: half of a draw and half of a list make no sense
NAME = r"^[A-Za-z0-9][A-Za-z0-9._+:-]*$"  # of a section; it becomes the name of a folder
# keys that a scene has under the same names
SAME = (
    "frames", "exposure_s", "role", "target", "mag_j", "window", "lenslets", "pupil_rotation_deg", "motion",
)  # fmt: skip
# Part of the photons in J+H that a filter passes.
THROUGHPUT = {"narrow_h": 0.14, "j": 0.5, "h": 0.5, "j_h": 1.0}

FIRST_START_UNIX_S = 1_707_618_000
SLOT_S = 86_400  # between the starts of two sections of a spec, so that a change of one moves no other
MOVE_S = 24  # time that focus stage or derotator take between the recordings of a series
FIRST_COUNTER, COUNTER_WRAP = 1000, 2**30


def base_scene(instrument: Instrument, seed: int, name: str, keys: RecordingKeys) -> Scene:
    """Return what all recordings of the section `name`, with its `keys`, have in common.

    Aberrations are drawn from the `seed` of the spec; what the section leaves out is that of the
    `instrument`.

    Raises `ConfigurationError` when the window is wider than the images that the sampling of the pupil
    allows, or the central hole as wide as the pupil.
    """
    diversity, lenslets = keys.diversity, keys.lenslet_images or LensletKeys()
    effects = {one: its for one, its in keys.hidden.items() if not hasattr(EFFECTS[one], "reached_nm")}
    scene = Scene(
        name=name,
        facility=_facility(instrument.facility, keys),
        bands=_bands(keys.bands),
        seed=(seed,),
        throughput=_throughput(keys),
        frame_rate_hz=keys.frame_rate_hz or 1 / keys.exposure_s,
        lenslet_tilts_mas=tuple(zip(lenslets.x_mas, lenslets.y_mas, strict=True)),
        lenslet_flux=lenslets.flux,
        pixel_scale_mas=_pixel_scale_mas(instrument, keys),
        ncpa_nm=_aberrations(keys.ncpa, instrument, seed, "ncpa"),
        rotating_nm=_aberrations(keys.rotating, instrument, seed, "rotating"),
        diversity_nm=dict(diversity.zernike) if diversity else {},
        diversity_source=diversity.source if diversity else "none",
        sky=keys.sky and keys.sky.residual,
        sky_e_per_s=_sky_e_per_s(instrument, keys),
        effects=effects,
        detector=keys.detector or DetectorModel(),
        sampling=keys.sampling or Sampling(),
        **{key: getattr(keys, key) for key in SAME},
    )
    if not math.isfinite(scene.facility.photons_per_s_m15):
        raise ConfigurationError(
            f"the profile {instrument.name} states no photons_per_s_m15, which mag_j needs; add the fact"
        )
    needed = scene.needed_samples  # below, the image of a sampled pupil would repeat itself
    if needed > scene.pupil_samples:
        raise ConfigurationError(
            f"a window of {max(scene.window)} px of {scene.pixel_scale_mas:g} mas "
            f"needs {needed} samples across the pupil; give sampling.pupil_samples >= {needed}, "
            "or a smaller window"
        )
    cutoff_per_m = scene.facility.cutoff_per_m  # the correction band must fit into the usual sampling
    needed = math.ceil(2 * cutoff_per_m * scene.geometry.diameter_m)
    if scene.sky is not None and scene.sampling.pupil_samples is None and needed > scene.pupil_samples:
        raise ConfigurationError(
            f"sky.cutoff_per_m = {cutoff_per_m:g} needs {needed} samples across the "
            f"pupil; give sampling.pupil_samples >= {needed}, or a lower cut-off"
        )
    return scene


def _aberrations(
    keys: AberrationKeys | None, instrument: Instrument, seed: int, what: str
) -> dict[int, float]:
    """Coefficients; the draw is the same for all recordings of a spec."""
    if keys is None:
        return {}
    modes_nm = dict(keys.zernike_nm or {})
    if keys.total_nm is not None:
        rng = np.random.default_rng([seed, number(what)])
        modes_nm = draw_ncpa_nm(rng, instrument.facility.ncpa_law, keys.total_nm, keys.modes)
    if keys.tail_nm:
        rng = np.random.default_rng([seed, number(f"{what} tail")])
        modes_nm = sum_nm([modes_nm, draw_tail_nm(rng, keys.tail_nm, *keys.tail_nolls)])
    return modes_nm


def _bands(bands: str | list[Band]) -> tuple[Band, ...]:
    if isinstance(bands, str):
        return BANDS[bands]
    total = sum(band.share for band in bands)
    return tuple(replace(band, share=band.share / total) for band in bands)


def _pixel_scale_mas(instrument: Instrument, keys: RecordingKeys) -> float:
    """As given, or the profile's usual scale; with lenslets, that of the mode on the day of the recording."""
    if keys.pixel_scale_mas:
        return keys.pixel_scale_mas
    if keys.lenslets > 1:
        modes = instrument.on(keys.start[:10] if keys.start else PRESENT).modes
        if keys.mode not in modes:
            raise ConfigurationError(f"mode: the profile {instrument.name} has no '{keys.mode}'")
        return modes[keys.mode].pixel_scale_mas
    if "pixel_scale_mas" not in instrument.defaults:
        raise ConfigurationError(f"the profile {instrument.name} has no default pixel_scale_mas; give one")
    return instrument.defaults["pixel_scale_mas"]


def _throughput(keys: RecordingKeys) -> float:
    """Part of the photons of the instrument's zero point that the bands pass."""
    default = THROUGHPUT[keys.bands] if isinstance(keys.bands, str) else 1.0
    return default if keys.throughput is None else keys.throughput


def _facility(facility: Facility, keys: RecordingKeys) -> Facility:
    """The instrument's facility with what the sections `sky` and `pupil` change of it."""
    given: dict[str, Any] = {name: getattr(keys.sky, name) for name in FACILITY_KEYS} if keys.sky else {}
    if keys.pupil is not None:
        hole_m, diameter_m = keys.pupil.obscuration_m, facility.pupil.diameter_m
        if hole_m >= diameter_m:
            raise ConfigurationError(
                f"pupil.obscuration_m = {hole_m:g} leaves nothing of a pupil of {diameter_m:g} m; give less"
            )
        given["pupil"] = replace(facility.pupil, obscuration_m=hole_m)
    return replace(facility, **{name: value for name, value in given.items() if value is not None})


def _sky_e_per_s(instrument: Instrument, keys: RecordingKeys) -> float:
    """Light of the sky in a pixel, as given or by the profile [e-/s]."""
    if not isinstance(keys.sky_e_per_s, str):
        return keys.sky_e_per_s
    facility, scale_mas = instrument.facility, _pixel_scale_mas(instrument, keys)
    if not facility.sky_mag_per_arcsec2:
        raise ConfigurationError(
            f"the profile {instrument.name} states no sky_mag_per_arcsec2; give sky_e_per_s as a number"
        )
    spectrum = [(band.centre_nm, band.share) for band in _bands(keys.bands)]
    photons_per_s_m0 = facility.photons_per_s_m15 * 10 ** (0.4 * 15) * _throughput(keys)
    return facility.sky_photons_per_s(spectrum, photons_per_s_m0, scale_mas) / keys.lenslets**2


def number(name: str) -> int:
    """Return the same number for the same `name` in every run, for seeds."""
    return crc32(name.encode())


class SpecKeys(Shared):
    """The whole file."""

    simulation: str = Field(min_length=1, description="name of the simulation")
    title: str = Field("", description="one line for people")
    instrument: str = Field(STANDARD, description="instrument profile: a name, or the path of a YAML file")
    seed: int = Field(0, ge=0, lt=2**63, description="seed of everything random")
    recordings: dict[str, RecordingKeys] = Field(min_length=1, description="name: section of each recording")


@dataclass(frozen=True)
class Spec:
    # name, title, instrument (its name, or the absolute path of its file) and seed, by their keys
    head: dict[str, Any]
    recordings: dict[str, RecordingKeys]  # by name, the shared sections filled in
    scenes: dict[str, Scene]  # what all recordings of such a section have in common

    @property
    def seed(self) -> int:
        return self.head["seed"]

    def resolved_yaml(self) -> str:
        """Return the spec with every default explicit; it makes the same recordings again."""
        recordings = {
            name: keys.model_dump(mode="json", exclude_none=True, by_alias=True)
            for name, keys in self.recordings.items()
        }
        return yaml_text(self.head | {"recordings": recordings})


def load_spec(path: str | Path, settings: Iterable[str] = (), seed: int | None = None) -> Spec:
    """Read and check the spec at `path`, or one that comes with the package by its name, such as ``on_sky``.

    The `settings` ``key.key=VALUE`` are applied in order; the value is YAML. The path of ``instrument=PATH``
    counts from the current folder. A `seed` replaces that of the spec.

    Raises `ConfigurationError` with one line ``where: message`` for everything that is wrong.
    """
    path = named_file(path, SIMULATIONS)
    data, errors = read_overridden(
        path, lambda text: located(parse_setting(text, SETTING_EXAMPLE)), settings, seed=seed
    )
    keys = errors.validated(data, SpecKeys)
    errors.raise_if_any()
    assert keys is not None, "what is wrong has been reported"
    for name in keys.recordings:
        if not re.match(NAME, name) or DOUBLE in name:
            errors.add(
                ("recordings", name),
                f"recordings.{name}: becomes the name of a folder; use letters, digits and . _ + : - "
                f"(no '{DOUBLE}'), beginning with a letter or digit",
            )
    instrument_name, instrument = checked_instrument(keys.instrument, absolute(path).parent, errors)
    recordings, scenes = {}, {}
    for name, own in data["recordings"].items():
        merged = errors.validated(_with_shared(own, data), RecordingKeys, ("recordings", name))
        if merged is None or instrument is None:
            continue
        recordings[name] = merged.completed(instrument.facility)
        try:
            scenes[name] = base_scene(instrument, keys.seed, name, recordings[name])
        except ConfigurationError as problem:
            errors.add(("recordings", name), f"recordings.{name}: {problem}")
    errors.raise_if_any()
    head = {
        "simulation": keys.simulation,
        "title": keys.title,
        "instrument": instrument_name,
        "seed": keys.seed,
    }
    return Spec(head, recordings, scenes)


def _with_shared(own: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """A recording's `own` sections over the `shared` ones, key by key; null switches a shared one off."""
    merged = {name: shared[name] for name in Shared.model_fields if name in shared} | dict(own)
    for name in merged.keys() & shared.keys() - WHOLE:
        if None not in (merged[name], shared[name]):
            merged[name] = {**shared[name], **merged[name]}
    return merged


def plan_recordings(spec: Spec) -> list[Planned]:
    """Return the recordings of a `spec`, those of a series in the order of their list."""
    sections = enumerate(spec.recordings.items())
    return [planned for slot, (name, keys) in sections for planned in _section(spec, slot, name, keys)]


def _section(spec: Spec, slot: int, name: str, keys: RecordingKeys) -> Iterator[Planned]:
    """Recordings of one section of the spec, which starts as declared or by its place (`slot`) there."""
    scene, hidden, profile = spec.scenes[name], keys.hidden, spec.head["instrument"]
    rng = np.random.default_rng([spec.seed, number(name), number("focus stage")])
    duration_s = MOVE_S + int(np.ceil(scene.frames * scene.period_s))
    first_s = FIRST_START_UNIX_S + slot * SLOT_S
    if keys.start is not None:
        first_s = int(np.datetime64(keys.start, "s").astype(int))
    for member, position, commanded_nm, reached, angle_deg in _members(name, keys, hidden, rng):
        after_s = position * duration_s
        own = replace(
            scene,
            name=member,
            seed=(spec.seed, number(member)),
            introduced_nm=reached,
            derotator_angle_deg=angle_deg,
            start_unix_s=first_s + after_s,
            first_counter=FIRST_COUNTER + after_s * LOOP_HZ % COUNTER_WRAP,
        )
        how = keys.layout, keys.mode, keys.side_car, "" if profile == STANDARD else profile
        yield Planned(member, own, commanded_nm, hidden, *how)


def _members(
    name: str, keys: RecordingKeys, hidden: Mapping, rng: np.random.Generator
) -> Iterator[tuple[str, int, Defocus, Defocus, float]]:
    """Name, place in time, commanded and reached defocus, and angle of every recording of a section."""
    effects, angle_deg = effects_of(hidden), keys.derotator_angle_deg
    if offsets_nm := keys.offsets_nm:
        order = visiting_order(offsets_nm, keys.order)
        reached = reached_nm([offsets_nm[index] for index in order], effects, rng).tolist()
        for index, own in enumerate(numbered(name, "offset", offsets_nm)):
            place = order.index(index)
            yield own, place, offsets_nm[index], reached[place], angle_deg
        return
    of_frames = reached_nm(np.broadcast_to(keys.introduced_nm, (keys.frames,)), effects, rng)
    commanded_nm: Defocus
    true_nm: Defocus
    if isinstance(keys.introduced_nm, list):
        commanded_nm, true_nm = tuple(keys.introduced_nm), tuple(of_frames.tolist())
    else:
        commanded_nm, true_nm = keys.introduced_nm, float(of_frames[0])
    names = numbered(name, "angle", keys.angles_deg) if keys.angles_deg else [name]
    for index, (own, angle) in enumerate(zip(names, keys.angles_deg or [angle_deg], strict=True)):
        yield own, index, commanded_nm, true_nm, angle


def numbered(name: str, what: str, values: Sequence[float]) -> list[str]:
    """Return ``<name>/<what>_<index>`` for each of `values`: the recordings of series `name`, by `what`."""
    digits = max(2, len(str(len(values) - 1)))
    return [f"{name}/{what}_{index:0{digits}d}" for index in range(len(values))]


def visiting_order(offsets_nm: Sequence[float], order: str) -> list[int]:
    """Return the indices of `offsets_nm` in the `order` of recording.

    ``ping_pong`` goes from the ends inwards and changes side after every offset, so that
    successive offsets are reached from opposite directions; ``as_given`` keeps the list.
    """
    if order == "as_given":
        return list(range(len(offsets_nm)))
    ascending = np.argsort(offsets_nm, kind="stable").tolist()
    inwards = [index for pair in zip(ascending, reversed(ascending), strict=True) for index in pair]
    return inwards[: len(ascending)]
