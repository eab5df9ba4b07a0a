"""From a section of a spec to a scene: bands, photometry, aberrations, sky, detector, effects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from zlib import crc32

import numpy as np

from irlos_pipe.conventions.bands import NARROW_H, H, J
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.effects.base import FocusStageEffect
from irlos_pipe.simulate.effects.catalogue import EFFECTS
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.ncpa import draw_ncpa_nm, draw_tail_nm
from irlos_pipe.simulate.recordings.recording_keys import (
    FACILITY_KEYS,
    AberrationKeys,
    LensletKeys,
    PupilKeys,
    RecordingKeys,
)
from irlos_pipe.simulate.scene import Sampling, Scene

BANDS = {
    "narrow_h": (Band.of(NARROW_H),),
    "j": (Band.of(J),),
    "h": (Band.of(H),),
    "j_h": (Band.of(J, 0.5), Band.of(H, 0.5)),
}
PRESENT = "2024-02-11"  # day of recordings whose start is not given
THROUGHPUT = {"narrow_h": 0.14, "j": 0.5, "h": 0.5, "j_h": 1.0}  # of the photons in J+H


def base_scene(instrument: Instrument, seed: int, name: str, keys: RecordingKeys) -> Scene:
    """Return what all recordings of the section `name`, with its `keys`, have in common.

    Parameters
    ----------
    instrument : Instrument
    seed : int
        Of the spec, from which aberrations are drawn.
    name : str
    keys : RecordingKeys

    Raises
    ------
    ConfigurationError
        When the window is wider than the images that the sampling of the pupil allows, or the central hole
        as wide as the pupil.
    """
    diversity = keys.diversity
    scene = Scene(
        name=name,
        facility=_facility(instrument.facility, keys),
        bands=_bands(keys.bands),
        seed=(seed,),
        frames=keys.frames,
        exposure_s=keys.exposure_s,
        role=keys.role,
        target=keys.target,
        mag_j=keys.mag_j,
        throughput=_throughput(keys),
        frame_rate_hz=keys.frame_rate_hz or 1 / keys.exposure_s,
        window=keys.window,
        lenslets=keys.lenslets,
        lenslet_tilts_mas=(keys.lenslet_images or LensletKeys()).tilts_mas,
        lenslet_flux=(keys.lenslet_images or LensletKeys()).flux,
        pixel_scale_mas=_pixel_scale_mas(instrument, keys),
        pupil_rotation_deg=keys.pupil_rotation_deg,
        ncpa_nm=_aberrations(keys.ncpa, instrument, seed, "ncpa"),
        rotating_nm=_aberrations(keys.rotating, instrument, seed, "rotating"),
        diversity_nm=dict(diversity.zernike) if diversity else {},
        diversity_source=diversity.source if diversity else "none",
        sky=keys.sky and keys.sky.residual,
        motion=keys.motion,
        sky_e_per_s=_sky_e_per_s(instrument, keys),
        effects=_within_scene(keys),
        detector=keys.detector or DetectorModel(),
        sampling=keys.sampling or Sampling(),
    )
    _require_unfolded(scene)
    _require_correction_band(scene)
    return scene


def _require_unfolded(scene: Scene) -> None:
    """Refuse a window in which the image of a sampled pupil would repeat itself."""
    needed = scene.needed_samples
    if needed > scene.pupil_samples:
        raise ConfigurationError(
            f"a window of {max(scene.window)} px of {scene.pixel_scale_mas:g} mas "
            f"needs {needed} samples across the pupil; give sampling.pupil_samples >= {needed}, "
            "or a smaller window"
        )


def _require_correction_band(scene: Scene) -> None:
    """Refuse a residual whose correction band the usual sampling of the pupil cannot hold."""
    cutoff_per_m, diameter_m = scene.facility.cutoff_per_m, scene.geometry.diameter_m
    needed = math.ceil(2 * cutoff_per_m * diameter_m)
    if scene.sky is not None and scene.sampling.pupil_samples is None and needed > scene.pupil_samples:
        raise ConfigurationError(
            f"sky.cutoff_per_m = {cutoff_per_m:g} needs {needed} samples across the "
            f"pupil; give sampling.pupil_samples >= {needed}, or a lower cut-off"
        )


def _within_scene(keys: RecordingKeys) -> dict[str, Mapping[str, Any]]:
    """Effects that act in the scene; those of the focus stage act on what it introduces."""
    given = keys.effects.given() if keys.effects else {}
    return {
        name: parameters
        for name, parameters in given.items()
        if not issubclass(EFFECTS[name], FocusStageEffect)
    }


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
        for noll, value_nm in draw_tail_nm(rng, keys.tail_nm, *keys.tail_nolls).items():
            modes_nm[noll] = modes_nm.get(noll, 0.0) + value_nm
    return modes_nm


def _bands(bands: str | list[Band]) -> tuple[Band, ...]:
    if isinstance(bands, str):
        return BANDS[bands]
    total = sum(band.share for band in bands)
    return tuple(replace(band, share=band.share / total) for band in bands)


def _pixel_scale_mas(instrument: Instrument, keys: RecordingKeys) -> float:
    scale = keys.pixel_scale_mas or _mode_scale_mas(instrument, keys)
    if scale is None:
        raise ConfigurationError(f"the profile {instrument.name} has no default pixel_scale_mas; give one")
    return scale


def _mode_scale_mas(instrument: Instrument, keys: RecordingKeys) -> float | None:
    """The profile's usual scale; with lenslets, that of the mode on the day of the recording."""
    if keys.lenslets == 1:
        return instrument.defaults.get("pixel_scale_mas")
    modes = instrument.on(keys.start[:10] if keys.start else PRESENT).modes
    if keys.mode not in modes:
        raise ConfigurationError(f"mode: the profile {instrument.name} has no '{keys.mode}'")
    return modes[keys.mode].pixel_scale_mas


def _throughput(keys: RecordingKeys) -> float:
    """Part of the photons of the instrument's zero point that the bands pass."""
    default = THROUGHPUT[keys.bands] if isinstance(keys.bands, str) else 1.0
    return default if keys.throughput is None else keys.throughput


def _facility(facility: Facility, keys: RecordingKeys) -> Facility:
    """The instrument's facility with what the sections `sky` and `pupil` change of it."""
    given = {name: getattr(keys.sky, name) for name in FACILITY_KEYS} if keys.sky else {}
    if keys.pupil is not None:
        given["pupil"] = _pupil(facility.pupil, keys.pupil)
    return replace(facility, **{name: value for name, value in given.items() if value is not None})


def _pupil(pupil: PupilGeometry, keys: PupilKeys) -> PupilGeometry:
    """The profile's pupil with what the section `pupil` changes of it."""
    if keys.obscuration_m >= pupil.diameter_m:
        raise ConfigurationError(
            f"pupil.obscuration_m = {keys.obscuration_m:g} leaves nothing of a pupil of "
            f"{pupil.diameter_m:g} m; give less"
        )
    return replace(pupil, obscuration_m=keys.obscuration_m)


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
