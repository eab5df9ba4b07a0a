"""Which recordings can be reduced together, by how they were taken; it needs no frame, and no PyTorch."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.wavefront import FilterNcpa
from irlos_pipe.estimate.calibration_options import DEFAULT_METHOD
from irlos_pipe.estimate.ramp import FEWEST, TOO_FEW
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.stages.base import Declared, ModelConfig

SETUP_KEYS = {
    key: key for key in ("pixel_scale_mas", "spectrum", "diversity", "pupil_rotation_deg", "lenslets")
}
OF_CALIBRATIONS = ("ncpa_calibration", "psf", "derotator")
OF_RAMPS = ("defocus_ramp", "psf")
COMMON = {
    "pixel_scale_mas": "pixel scale",
    "pupil_rotation_deg": "rotation of the pupil",
    "derotator_angle_deg": "derotator angle",
}
TURNED_DEG = 1.0  # angle of the derotator from which a recording is of another one


def turned_angles(angles_deg: Iterable[float], own_deg: float) -> str:
    """Return angles of the derotator as text if one is another than `own_deg`; a whole turn is none."""
    angles = sorted({*angles_deg})
    turned = any(abs(math.remainder(angle - own_deg, 360.0)) > TURNED_DEG for angle in angles)
    return ", ".join(f"{angle:g}°" for angle in angles) if turned else ""


def elements_of(acquisition: Acquisition) -> tuple[str, str]:
    """Return the names of the filter and of the source of the diversity, of an `acquisition`.

    A filter without a name goes by its mean wavelength and the width of its band.
    """
    wavelengths_nm, weights = np.array(acquisition.spectrum, float).T
    band = f"{np.average(wavelengths_nm, weights=weights):.0f} nm, {np.ptp(wavelengths_nm):.0f} nm wide"
    return acquisition.filter or band, acquisition.diversity_source


def require_one_setup(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError unless all recordings share window, pixel scale, spectrum and diversity."""
    for other, differing in _unlike_the_first(recordings, SETUP_KEYS):
        raise InputDataError(
            f"{other.name}: {', '.join(differing)} differ from those of {recordings[0].name}; "
            "reduce recordings of different set-ups separately"
        )


def require_common(recordings: Sequence[Recording], terms: Mapping[str, str], together: str) -> None:
    """Raise InputDataError, which says what may differ `together`, unless all have the numbers of `terms`."""
    for other, differing in _unlike_the_first(recordings, terms):
        raise InputDataError(
            f"{other.name}: {' and '.join(differing)} of {recordings[0].name} are others; {together}"
        )


def _unlike_the_first(
    recordings: Sequence[Recording], terms: Mapping[str, str]
) -> Iterator[tuple[Recording, list[str]]]:
    """Recordings that differ from the first one, and in what.

    `terms` names the numbers of the acquisition that may differ; the window is compared as well.
    """
    for other in recordings[1:]:
        here, there = recordings[0].acquisition, other.acquisition
        differing = [term for key, term in terms.items() if getattr(here, key) != getattr(there, key)]
        if recordings[0].window != other.window:
            differing.append("window")
        if differing:
            yield other, differing


def by_setup(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Return frames of `recordings` of the same band, filter, diversity and introduced defocus together."""
    groups: dict[tuple, list[Recording]] = {}
    for recording in recordings:
        acquisition = recording.acquisition
        diversity = tuple(sorted((noll, nm) for noll, nm in acquisition.diversity.items() if nm))
        for plane in recording.planes():
            focus = tuple(np.unique(plane.introduced_defocus_nm).tolist())
            key = acquisition.spectrum, elements_of(acquisition), diversity, focus
            groups.setdefault(key, []).append(plane)
    return list(groups.values())


def of_several_setups(recordings: Sequence[Recording]) -> bool:
    """Return whether frames differ in what is known of wavefront or light, and are fitted jointly."""
    introduced_nm = np.concatenate([one.introduced_defocus_nm for one in recordings])
    return len(np.unique(introduced_nm)) > 1 or any(_unlike_the_first(recordings, SETUP_KEYS))


def require_joint(
    model: ModelConfig, groups: Sequence[Sequence[Recording]], method: str, *, adjust: bool = False
) -> None:
    """Refuse groups of recordings that cannot be calibrated together.

    Raises `InputDataError` if they differ in more than band, filter, diversity and focus;
    `ConfigurationError` for a `method` of one set-up, as one that can `adjust` the instrument, and a
    `filter_ncpa` that does not say of which filter or lens.
    """
    together = "set-ups calibrated together may differ in band, filter, diversity and introduced defocus only"
    require_common([recording for group in groups for recording in group], COMMON, together)
    if method != DEFAULT_METHOD or adjust:
        other_method = f"method {method}", f"use {DEFAULT_METHOD}"
        what, instead = ("adjust", "leave it out") if adjust else other_method
        raise ConfigurationError(
            f"calibrate.{what} takes frames of one set-up, and those given differ in band, filter, diversity "
            f"or introduced defocus; {instead}"
        )
    names = sorted({name for group in groups for name in elements_of(group[0].acquisition) if name})
    for entry in model.entries():
        if entry.name == FilterNcpa.name and entry.options.get("of") not in names:
            raise ConfigurationError(
                f"model.effects: filter_ncpa: say of which filter or source of diversity, of: one of "
                f"{', '.join(map(repr, names))}"
            )


def require_calibration(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError for `recordings` that are no cubes of one static wavefront."""
    takes = f"a calibration takes recordings of role {', '.join(OF_CALIBRATIONS)}"
    _require_role(recordings, OF_CALIBRATIONS, takes)


def _require_role(recordings: Sequence[Recording], roles: Sequence[str], takes: str) -> None:
    """Raise InputDataError, which says what a stage `takes`, for a recording of none of the `roles`."""
    for one in recordings:
        if one.acquisition.role not in roles:
            raise InputDataError(
                f"{one.name}: its role is {one.acquisition.role}; {takes}: give another one, or correct the "
                "role in the side-car"
            )


def require_ramp(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError unless `recordings` are frames of one set-up that LIFT takes."""
    require_one_setup(recordings)
    _require_role(recordings, OF_RAMPS, f"LIFT takes recordings of role {' or '.join(OF_RAMPS)}")


def require_line(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError for `recordings` of a ramp with too few frames or offsets for a straight line."""
    introduced_nm = np.concatenate([one.introduced_defocus_nm for one in recordings])
    if is_ramp(recordings) and (len(introduced_nm) < FEWEST or np.ptp(introduced_nm) == 0):
        raise InputDataError(f"ramp of {len(recordings)} recordings: {TOO_FEW}")


def is_ramp(recordings: Sequence[Recording]) -> bool:
    """Whether `recordings` are no frames of one focus that nobody knows."""
    introduced_nm = np.concatenate([one.introduced_defocus_nm for one in recordings])
    return {one.acquisition.role for one in recordings} != {"psf"} or np.ptp(introduced_nm) > 0


def require_parts(declared: Declared) -> None:
    """Raise ConfigurationError where an effect of parts of the pupil has no parts."""
    if any(hasattr(CATALOGUE[entry.name], "parts_of") for entry in declared.model.entries()):
        effects = import_module("irlos_pipe.stages.model.effects")  # which takes PyTorch
        effects.model_effects(declared.instrument, declared.model, declared.recordings[0])
