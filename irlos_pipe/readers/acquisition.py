"""Settle how a recording was taken: recipe over side-car over header over instrument profile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.seeing import SPARTA
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.frames.recording import (
    HEADER,
    MODE,
    PROFILE,
    RECIPE,
    SIDECAR,
    Acquisition,
    Detector,
)
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.altitude import altitude_deg
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.sidecar import AcquisitionKeys, SpectrumPoint, read_sidecar, sidecar_path
from irlos_pipe.readers.star_spectrum import spectrum_of, temperature_of
from irlos_pipe.readers.told_reads import COADDS, READ_S, reads_of

REQUIRED = ("role", "spectrum", "diversity")  # no value is safe to assume
REQUIRED_OF_DARK = ("role",)
REQUIRED_OF_RAMP = (*REQUIRED, "introduced_defocus_nm")
HARMLESS = {
    "introduced_defocus_nm": 0.0,
    "derotator_angle_deg": 0.0,
    "pupil_rotation_deg": 0.0,
    "target": "",
    "filter": "",
    "dispersion_corrected": False,
    "sky_e_per_s": 0.0,
}
ALTITUDE = ("altitude_deg", "airmass")  # two ways to say the same
OF_THE_SKY = (
    "parallactic_angle_deg",
    "altitude_deg",
    "airmass",
    "zenith_angle_deg",
    "pressure_hpa",
    "temperature_c",
    "humidity_percent",
    "star_temperature_k",
    "j_minus_h",
)
NOT_WORTH_A_WARNING = {
    *HARMLESS,
    *OF_THE_SKY,
    "detector.excess_noise_factor",
    "detector.read_s",
    "detector.dark_e_per_s",
}


@dataclass(frozen=True)
class Resolved:
    """How a recording was taken, from all sources.

    Attributes
    ----------
    introduced_defocus_nm : ndarray, (frames,)
        Introduced defocus [nm RMS].
    warnings : tuple of str
        What had to be taken from the header or the instrument profile.
    """

    acquisition: Acquisition
    introduced_defocus_nm: np.ndarray
    warnings: tuple[str, ...]


def resolve(raw: RawRecording, recipe: AcquisitionKeys, instrument: Instrument) -> Resolved:
    """Find the value of every key, and remember where it came from.

    Parameters
    ----------
    raw : RawRecording
        The recording, with what its header knows.
    recipe : AcquisitionKeys
        What the recipe says; it wins over everything.
    instrument : Instrument
        Its profile gives the values that are stated nowhere else, where that is safe.

    Raises
    ------
    InputDataError
        A key without a safe default is missing, or there is not one defocus per frame.
    """
    path = sidecar_path(raw.path)
    told = read_sidecar(path).flat()
    layers = {
        RECIPE: recipe.flat(),
        SIDECAR: told,
        HEADER: _unless_told(_plausible(raw.header), {**told, **recipe.flat()}),
        MODE: raw.of_mode,
        PROFILE: instrument.defaults | HARMLESS,
    }
    values, sources = _settle(layers)
    where = f"{path}:" if path.exists() else f"{raw.path}: no side-car {path.name};"
    if "spectrum" not in values and "filter_curve" in values:
        values["spectrum"], sources["spectrum"] = _spectrum(values, where), sources["filter_curve"]
    _require(values, sources, where)
    values["pupil_rotation_deg"] = _pupil_rotation(values, sources, instrument, where)
    for key, value in _of_the_sky(values, instrument, where).items():
        values[key], sources[key] = value, sources.get(key, PROFILE)
    exposure_s = _exposure_s(values, sources)
    if exposure_s is not None:  # an archive may have lost it; the frames then tell their noise
        values["exposure_s"] = exposure_s
    reads = reads_of(values, sources, where)
    defocus = _per_frame(values["introduced_defocus_nm"], raw, sources["introduced_defocus_nm"])
    warnings = _warnings(raw, values, sources)
    monitor = _seeing_monitor(layers, sources)
    if monitor != SPARTA:
        values, line = _on_sparta_scale(raw, values, monitor, instrument)
        warnings = (*warnings, line)
    return Resolved(_acquisition(raw, values, sources, reads), defocus, warnings)


def _settle(layers: Mapping[str, Mapping[str, Any]]) -> tuple[dict[str, Any], dict[str, str]]:
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for source, layer in layers.items():
        for key, value in layer.items():
            if key not in values:
                values[key], sources[key] = value, source
    return values, sources


def _seeing_monitor(layers: Mapping[str, Mapping[str, Any]], sources: Mapping[str, str]) -> str:
    """Whose scale the seeing is on: as the recipe says, else as the source of the seeing says."""
    source = sources.get("seeing_arcsec", PROFILE)
    if source == PROFILE:
        return SPARTA
    return layers[RECIPE].get("seeing_scale") or layers[source].get("seeing_scale", SPARTA)


def _on_sparta_scale(
    raw: RawRecording, values: Mapping[str, Any], monitor: str, instrument: Instrument
) -> tuple[dict[str, Any], str]:
    """The values with the seeing translated, and a line that says so."""
    scales = instrument.seeing_scales
    if monitor not in scales:
        raise InputDataError(
            f"{raw.path}: seeing_scale = '{monitor}' is not known to the instrument profile"
            f"{suggestion(monitor, scales)}"
        )
    given = values["seeing_arcsec"]
    seeing = scales[monitor].to_sparta(given)
    if seeing <= 0:
        raise InputDataError(
            f"{raw.path}: seeing_arcsec = {given:g} by {monitor} would be {seeing:.3g} by SPARTA; "
            "correct it, or the scale in the instrument profile"
        )
    line = f"{raw.name}: seeing of {given:.2f} arcsec by {monitor} taken as {seeing:.2f} arcsec by SPARTA"
    return {**values, "seeing_arcsec": seeing}, line


def _plausible(header: Mapping[str, Any]) -> dict[str, Any]:
    """Drop header values out of the range of their key: ESO writes -1 where nothing was measured."""
    return {key: value for key, value in header.items() if _is_valid(key, value)}


def _unless_told(header: Mapping[str, Any], told: Mapping[str, Any]) -> dict[str, Any]:
    """Drop altitude and airmass of a header where either is `told`: they are of another moment."""
    dropped = ALTITUDE if any(key in told for key in ALTITUDE) else ()
    return {key: value for key, value in header.items() if key not in dropped}


def _is_valid(key: str, value: Any) -> bool:
    section, _, inner = key.rpartition(".")
    try:
        AcquisitionKeys.model_validate({section: {inner: value}} if section else {key: value})
    except ValidationError:
        return False
    return True


def _require(values: Mapping[str, Any], sources: Mapping[str, str], where: str) -> None:
    role = values.get("role")
    needed = {"dark": REQUIRED_OF_DARK, "defocus_ramp": REQUIRED_OF_RAMP}.get(str(role), REQUIRED)
    missing = [key for key in needed if sources.get(key, PROFILE) == PROFILE]
    if missing:
        keys = "key" if len(missing) == 1 else "keys"
        raise InputDataError(
            f"{where} {keys} {', '.join(map(repr, missing))} missing, and no default is safe; "
            "add to the side-car, or to the recipe under ingest.acquisition"
        )


def _pupil_rotation(
    values: Mapping[str, Any], sources: Mapping[str, str], instrument: Instrument, where: str
) -> float:
    """As stated; else by the profile's rule, where it has one, from the angles of the recording [deg]."""
    rule = instrument.profile.pupil.turns if instrument.profile.pupil else None
    if sources["pupil_rotation_deg"] != PROFILE or rule is None or values["role"] == "dark":
        return values["pupil_rotation_deg"]
    missing = [key for key in rule.factors if sources.get(key, PROFILE) == PROFILE]
    if missing:
        angles = ", ".join(map(repr, missing))
        raise InputDataError(
            f"{where} the pupil of {instrument.name} turns with {angles}, which is not known; give it, or "
            "pupil_rotation_deg"
        )
    return rule.rotation_deg(values)


def _spectrum(values: Mapping[str, Any], where: str) -> list[SpectrumPoint]:
    """What the curve of the filter passes of the star."""
    kelvin = values.get("star_temperature_k")
    if kelvin is None and "j_minus_h" in values:
        kelvin = temperature_of(values["j_minus_h"], where)
    if kelvin is None:
        raise InputDataError(f"{where} filter_curve needs the star: give star_temperature_k or j_minus_h")
    points = spectrum_of(values["filter_curve"], kelvin, where)
    return [SpectrumPoint(wavelength_nm=nm, weight=weight) for nm, weight in points]


def _of_the_sky(values: Mapping[str, Any], instrument: Instrument, where: str) -> dict[str, float]:
    """Altitude and direction of the zenith, as far as they are known [deg].

    The altitude as stated, or from the airmass; the direction as stated, or by the profile's rule.
    """
    altitude = altitude_deg(values.get("altitude_deg"), values.get("airmass"), where)
    found = {} if altitude is None else {"altitude_deg": altitude}
    rule, known = instrument.profile.zenith, {**values, **found}
    if "zenith_angle_deg" not in values and rule is not None and rule.factors.keys() <= known.keys():
        found["zenith_angle_deg"] = rule.rotation_deg(known)
    return found


def _per_frame(defocus_nm: float | list[float], raw: RawRecording, source: str) -> np.ndarray:
    values = np.atleast_1d(np.asarray(defocus_nm, dtype=np.float64))
    if values.size not in (1, raw.frames):
        where = sidecar_path(raw.path) if source == SIDECAR else f"{source}: {raw.path}"
        raise InputDataError(
            f"{where}: introduced_defocus_nm has {values.size} values for {raw.frames} frames; "
            "give one, or one per frame"
        )
    return np.broadcast_to(values, (raw.frames,)).copy()


def _exposure_s(values: Mapping[str, Any], sources: dict[str, str]) -> float | None:
    """As told; else of as many reads as told, before what the profile says."""
    told = [sources.get(key, PROFILE) != PROFILE for key in (COADDS, READ_S)]
    if all(told) and sources.get("exposure_s", PROFILE) == PROFILE:
        sources["exposure_s"] = sources[READ_S]
        return values[COADDS] * values[READ_S]
    return values.get("exposure_s")


def _acquisition(
    raw: RawRecording, values: Mapping[str, Any], sources: dict[str, str], reads: int
) -> Acquisition:
    diversity = values.get("diversity")
    spectrum = values.get("spectrum", ())
    optional = {
        key: values.get(key)
        for key in (
            "mag_j",
            "exposure_s",
            "frame_rate_hz",
            "seeing_arcsec",
            "parallactic_angle_deg",
            "altitude_deg",
            "zenith_angle_deg",
            "pressure_hpa",
            "temperature_c",
            "humidity_percent",
        )
    }
    return Acquisition(
        role=values["role"],
        detector=_detector(values, reads, told_reads=sources.get(READ_S, PROFILE) != PROFILE),
        spectrum=tuple((point.wavelength_nm, point.weight) for point in spectrum),
        diversity=dict(diversity.zernike) if diversity else {},
        diversity_source=diversity.source if diversity else "",
        pixel_scale_mas=values["pixel_scale_mas"],
        target=values["target"],
        derotator_angle_deg=values["derotator_angle_deg"],
        pupil_rotation_deg=values["pupil_rotation_deg"],
        dispersion_corrected=values["dispersion_corrected"],
        filter=values["filter"],
        mode=raw.mode,
        lenslets=raw.lenslets,
        sources=sources,
        **optional,
    )


def _detector(values: Mapping[str, Any], reads: int, *, told_reads: bool) -> Detector:
    """Constants of a frame; the keys are those of one read, of which a frame is the sum or mean."""
    coadds = values.get(COADDS, reads if told_reads else 1)
    background_e_per_s = values["sky_e_per_s"] + values.get("detector.dark_e_per_s", 0.0)
    averaged = values.get("detector.coadds_averaged", False)
    saturation = values.get("detector.saturation_adu")
    return Detector(
        e_per_adu=values["detector.e_per_adu"] * (coadds if averaged else 1),
        read_noise_e=values["detector.read_noise_e"] * reads**0.5,
        excess_noise_factor=values.get("detector.excess_noise_factor", 1.0),
        saturation_adu=saturation if saturation is None or averaged else saturation * coadds,
        reads=reads,
        background_e=background_e_per_s * (values.get("exposure_s") or 0.0),
    )


def _warnings(raw: RawRecording, values: Mapping[str, Any], sources: Mapping[str, str]) -> tuple[str, ...]:
    """One line per source from which values had to be taken, and one for what stays unknown."""
    lines = []
    for source in (HEADER, MODE, PROFILE):
        taken = [
            f"{key} = {values[key]:.6g}"
            for key in sorted(values)
            if sources[key] == source and key not in NOT_WORTH_A_WARNING and isinstance(values[key], float)
        ]
        if taken:
            lines.append(f"{raw.name}: taken from the {source}: {', '.join(taken)}")
    if "mag_j" not in values and values["role"] != "dark":
        lines.append(f"{raw.name}: mag_j is not known; magnitudes can only come from the measured flux")
    return tuple(lines)
