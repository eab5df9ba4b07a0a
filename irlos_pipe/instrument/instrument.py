"""Instrument profiles: geometry, safe defaults and read-out modes, each value with its source."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.facility import Facility, VibrationLine
from irlos_pipe.conventions.laws import SPARTA, NcpaLaw, ResidualLaw, SeeingScale
from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.validation import Origins, Override, ValidationErrors, absolute, require_valid
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.instrument.profile import (
    FACTS,
    Fact,
    ModeEntry,
    Profile,
    PupilSection,
    Ratio,
    SeeingScaleEntry,
    drawn,
    require_usable,
)

PROFILES = Path(__file__).parent
PARANAL_DEG = -70.4  # longitude, east of Greenwich
PROFILE_SUFFIXES = (".yaml", ".yml")
CIRCLE = "circle"
TELESCOPES = {"vlt": "irlos", "palomar": "pharo", "keck": "nirc2_narrow"}  # names of pupils: the profile
CORRECTED_CYCLES = 20.0  # per diameter, of adaptive optics of which nothing is declared: as of the VLT
ORIGIN = {"status": "adopted", "source": "declared with the images"}
SIZES = ("diameter_m", "obscuration", "obscuration_m", "vanes", "map", "metres_per_sample")
MAP_FILE = "pupil_map.fits"


@dataclass(frozen=True)
class Mode:
    """A read-out mode: lenslets per side of the pupil are 1 in full-pupil modes, 2 in 2x2 modes.

    `e_per_adu` are photo-electrons per ADU, the avalanche gain taken out.
    """

    name: str
    lenslets: int
    frame_rate_hz: float
    pixel_scale_mas: float
    e_per_adu: float


@dataclass(frozen=True)
class Instrument:
    """An instrument as it was on one day."""

    name: str
    facility: Facility
    defaults: dict[str, float]  # by keys of the side-car that may be left out (``detector.`` keys dotted)
    modes: dict[str, Mode]  # by the mode string of the header
    seeing_scales: dict[str, SeeingScale]  # by the seeing monitor; ``sparta`` is always among them
    profile: Profile  # the file, with unit, source and status of every value
    folder: Path = field(default=PROFILES, compare=False)  # of the file, from which the paths of maps count

    @property
    def pupil(self) -> PupilGeometry:
        return self.facility.pupil

    @property
    def facts(self) -> dict[str, list[Fact]]:
        """Every value with unit, source and status, dated where it changed."""
        return self.profile.facts

    @property
    def longitude_deg(self) -> float:
        """Of the site, east of Greenwich."""
        stated = self.facts.get("site_longitude_deg")
        return float(stated[-1].value) if stated else PARANAL_DEG

    def on(self, day: str) -> "Instrument":
        """Return the instrument as it was on an ISO date `day` (``2021-03-20``)."""
        return _instrument(self.profile, day, self.folder)


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Load an instrument profile, with the values of the present day.

    It is the name of one that comes with the package, or the path of a YAML file.

    Raises `ConfigurationError` for an unknown name (with a suggestion), or a profile that cannot be used
    (``file:line: problem``).
    """
    path = _profile_path(str(name_or_path))
    data, lines = load_yaml(path)
    profile = require_valid(data, Profile, Origins(path, lines))
    try:
        return _instrument(profile, None, path.parent)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from None


def checked_instrument(name: str, folder: Path, errors: ValidationErrors) -> tuple[str, Instrument | None]:
    """Load the profile `name` that a settings file asks for; a path counts from the `folder` of that file.

    One that cannot be used is noted in `errors`, under ``instrument``. Returns the name, or the absolute
    path, and the instrument.
    """
    if is_path(name):
        name = str(absolute(name, folder))
    try:
        return name, load_instrument(name)
    except ConfigurationError as error:
        errors.add(("instrument",), str(error))
        return name, None


def located(override: Override) -> Override:
    """A setting of the command line; the path in ``instrument=PATH`` counts from the current folder."""
    if override.key != ("instrument",) or not is_path(str(override.value)):
        return override
    return replace(override, value=str(absolute(str(override.value))))


def is_path(name: str) -> bool:
    """Return whether a profile is stated by its path."""
    return "/" in name or name.endswith(PROFILE_SUFFIXES)


def _profile_path(name: str) -> Path:
    if is_path(name):
        return Path(name)
    known = sorted(path.stem for path in PROFILES.glob("*.yaml"))
    if name not in known:
        raise ConfigurationError(f"unknown instrument '{name}'{suggestion(name, known)}")
    return PROFILES / f"{name}.yaml"


def _instrument(profile: Profile, day: str | None, folder: Path) -> Instrument:
    values = _Values(profile.facts, day)
    return Instrument(
        name=profile.name,
        facility=_facility(values, _pupil(profile, values, folder)),
        defaults={key: values.resolve(reference) for key, reference in profile.defaults.items()},
        modes={name: _mode(name, entry, values) for name, entry in profile.modes.items()},
        seeing_scales={SPARTA: SeeingScale()}
        | {name: _seeing_scale(name, entry, values) for name, entry in profile.seeing_scales.items()},
        profile=profile,
        folder=folder,
    )


class _Values:
    """Values of the facts as they were on one day."""

    def __init__(self, facts: dict[str, list[Fact]], day: str | None) -> None:
        self._facts, self._day = facts, day

    def __getitem__(self, name: str) -> Any:
        if name not in self._facts:
            raise ConfigurationError(f"no fact '{name}'{suggestion(name, self._facts)}")
        holding = [fact for fact in self._facts[name] if fact.holds_on(self._day)]
        if len(holding) != 1:
            raise ConfigurationError(
                f"fact '{name}' has {len(holding)} values on {self._day or 'the present day'}; "
                "exactly one must hold"
            )
        return holding[0].value

    def get(self, name: str, default: Any) -> Any:
        """Return the value of a fact, or `default` where the profile does not state it."""
        return self[name] if name in self._facts else default

    def resolve(self, reference: str | Ratio) -> float:
        """Return the value of a fact, or the first one divided by the others."""
        if isinstance(reference, str):
            return self.number(reference)
        first, *others = reference.divide
        divisor = prod(self.number(name) for name in others)
        if divisor == 0:
            raise ConfigurationError(f"'{first}' cannot be divided by {', '.join(others)}, which make zero")
        return self.number(first) / divisor

    def number(self, name: str) -> float:
        value = self[name]
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ConfigurationError(f"fact '{name}' = {value!r} should be a number")
        return float(value)


def _facility(values: _Values, pupil: PupilGeometry) -> Facility:
    lines, sky = values.get("vibration_lines", ()), values.get("sky_mag_per_arcsec2", ())
    # a bench states none of these: without a residual neither cut-off nor outer scale acts
    return Facility(
        pupil=pupil,
        photons_per_s_m15=float(values.get("photons_per_s_m15", math.nan)),
        cutoff_per_m=float(values.get("ao_cutoff_per_m", min(20 / pupil.diameter_m, 1000.0))),
        outer_scale_m=float(values.get("outer_scale_m", 25.0)),
        residual_law=ResidualLaw(
            float(values.get("ao_residual_nm_per_arcsec", 0.0)),
            float(values.get("ao_residual_floor_nm", 0.0)),
        ),
        ncpa_law=NcpaLaw(*map(values.number, ("ncpa_amplitude_nm", "ncpa_decay", "ncpa_plateau_nm"))),
        typical_seeing_arcsec=float(values.get("seeing_arcsec", math.nan)),
        vibration_lines=tuple(VibrationLine(*map(float, line)) for line in lines),
        numerical_aperture=float(values.get("focus_numerical_aperture", 0.0)),
        sky_mag_per_arcsec2=tuple((float(nm), float(mag)) for nm, mag in sky),
    )


def _pupil(profile: Profile, values: _Values, folder: Path) -> PupilGeometry:
    width = float(values.get("pupil_vane_width_m", 0.0))
    vanes = tuple(Vane(tuple(start), tuple(end), width) for start, end in values.get("pupil_vanes_m", ()))
    obscuration_m = float(values.get("pupil_obscuration_m", 0.0))
    try:
        plain = PupilGeometry(values.number("pupil_diameter_m"), obscuration_m, vanes)
        pupil = drawn(plain, profile.pupil, folder) if profile.pupil else plain
        require_usable(pupil)
    except ValueError as problem:
        raise ConfigurationError(f"pupil: {problem}") from None
    return pupil


def _seeing_scale(name: str, entry: SeeingScaleEntry, values: _Values) -> SeeingScale:
    scale = SeeingScale(values.resolve(entry.ratio), values.resolve(entry.offset_arcsec))
    if not scale.ratio > 0:
        raise ConfigurationError(f"seeing scale '{name}': ratio {scale.ratio:g} should be positive")
    return scale


def _mode(name: str, entry: ModeEntry, values: _Values) -> Mode:
    e_per_adu = values.resolve(Ratio(divide=["amplifier_e_per_adu", entry.apd_gain]))
    return Mode(name, entry.lenslets, entry.frame_rate_hz, values.resolve(entry.pixel_scale), e_per_adu)


def made_profile(
    pupil: str | Mapping[str, Any] | np.ndarray, facts: Mapping[str, Any]
) -> tuple[dict[str, Any], np.ndarray | None]:
    """Return the content of a profile, and the amplitude map that it expects beside it as `MAP_FILE`.

    `pupil` and `facts` are those of `irlos_pipe.calibrate`, the diameter as ``pupil_diameter_m``. The camera
    is that of the profile `bench`, the adaptive optics are those of the telescope, or of the VLT.

    Raises `ConfigurationError` for unknown names and keys, and numbers that are missing.
    """
    named = isinstance(pupil, str) and pupil != CIRCLE
    names = {path.stem: path.stem for path in sorted(PROFILES.glob("*.yaml"))} | TELESCOPES
    if named and pupil not in names:
        raise ConfigurationError(f"unknown pupil '{pupil}'{suggestion(pupil, [CIRCLE, *names])}")
    if named and "pupil_diameter_m" in facts:
        raise ConfigurationError(f"pupil '{pupil}' has its diameter; leave diameter_m out")
    telescope = load_yaml(PROFILES / f"{names[str(pupil)] if named else 'irlos'}.yaml")[0]
    known, own = {name: fact for name, fact in telescope["facts"].items() if name in FACTS}, dict(facts)
    section, samples = telescope.get("pupil"), None
    if not named:
        known = {name: fact for name, fact in known.items() if "pupil" not in name}
        numbers = pupil if isinstance(pupil, Mapping) else {} if isinstance(pupil, str) else {"map": pupil}
        section, samples = _drawn(dict(numbers), own)
        own = {"ao_cutoff_per_m": CORRECTED_CYCLES / (own["pupil_diameter_m"] or math.nan)} | own
    known |= {name: {"value": value, "unit": FACTS[name].unit} | ORIGIN for name, value in own.items()}
    made = load_yaml(PROFILES / "bench.yaml")[0]
    made |= {"name": "as declared", "title": "", "facts": made["facts"] | known}
    return made | ({"pupil": ORIGIN | section} if section else {}), samples


def _drawn(numbers: dict[str, Any], facts: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray | None]:
    """The section `pupil` of a profile, and its map; the sizes go to the `facts`."""
    allowed = (*SIZES, *(key for key in PupilSection.model_fields if key not in ORIGIN))
    for key in numbers:
        if key not in allowed:
            raise ConfigurationError(f"pupil: unknown key '{key}'{suggestion(key, allowed)}")
    diameter_m = numbers.pop("diameter_m", facts.get("pupil_diameter_m"))
    if diameter_m is None:
        raise ConfigurationError("pupil: diameter_m is missing, the diameter in metres")
    vanes, step_m, samples = numbers.get("vanes"), numbers.pop("metres_per_sample", None), None
    try:
        hole_m = float(numbers.pop("obscuration", 0.0)) * (diameter_m := float(diameter_m))
        if isinstance(vanes, Mapping):
            ends_m = 0.525 * diameter_m * np.exp(1j * np.radians(np.ravel(vanes["angles_deg"])))
            ends = [[end.real, end.imag] for end in ends_m.tolist()]
            width = {"start_m": [0, 0], "width_m": vanes["width_m"]}
            numbers["vanes"] = [{"end_m": end} | width for end in ends]
        if "map" in numbers:
            samples = np.asarray(numbers["map"], float)
            step_m = step_m or diameter_m / max(1, *samples.shape, 1)
            numbers["map"] = {"file": MAP_FILE, "metres_per_sample": step_m}
    except (KeyError, TypeError, ValueError):
        known = "numbers of diameter_m and obscuration, vanes {'angles_deg': [...], 'width_m': ...}, an array"
        raise ConfigurationError(f"pupil: should be {known}") from None
    facts |= {"pupil_diameter_m": diameter_m, "pupil_obscuration_m": numbers.pop("obscuration_m", hole_m)}
    return numbers, samples
