"""The side-car of a simulated recording: what an observer knows, nothing of the truth."""

from __future__ import annotations

from typing import Any

from irlos_pipe.simulate.detector import ADC_TOP_ADU, DetectorModel
from irlos_pipe.simulate.recordings.planned import Defocus, Planned
from irlos_pipe.simulate.scene import Scene

POINTS_PER_BAND = 3


def side_car(planned: Planned) -> dict[str, Any]:
    """Return the content of ``acquisition.yaml`` of a `planned` recording; a bench has no seeing."""
    scene = planned.scene
    stated = {
        "role": scene.role,
        "target": scene.target,
        "mag_j": scene.mag_j,
        "exposure_s": scene.exposure_s,
        "frame_rate_hz": scene.frame_rate_hz,
        "pixel_scale_mas": scene.pixel_scale_mas,
        "seeing_arcsec": scene.sky.seeing_arcsec if scene.sky is not None else None,
        "spectrum": declared_spectrum(scene),
        "diversity": {"source": scene.diversity_source, "zernike": dict(scene.diversity_nm)},
        "introduced_defocus_nm": _plain(planned.commanded_nm),
        "derotator_angle_deg": scene.derotator_angle_deg,
        "pupil_rotation_deg": scene.pupil_rotation_deg or None,
        "sky_e_per_s": float(f"{scene.sky_e_per_s:.3g}") or None,
        "detector": _detector(scene.detector, scene.reads),
    }
    return {key: value for key, value in stated.items() if value is not None}


def _plain(defocus_nm: Defocus) -> float | list[float]:
    return list(defocus_nm) if isinstance(defocus_nm, tuple) else defocus_nm


def declared_spectrum(scene: Scene) -> list[dict[str, float]]:
    """Return a few wavelengths per band of a `scene` with their photon weights."""
    weights: dict[float, float] = {}
    for wavelength_nm, weight in scene.spectrum(POINTS_PER_BAND):
        at = round(wavelength_nm, 3)  # the points of a band without width are the same
        weights[at] = weights.get(at, 0.0) + weight
    return [{"wavelength_nm": at, "weight": round(weight, 6)} for at, weight in weights.items()]


def _detector(detector: DetectorModel, reads: int) -> dict[str, float]:
    stated = {"e_per_adu": detector.e_per_adu, "read_noise_e": detector.read_noise_e}
    if detector.excess_noise_factor != 1:
        stated["excess_noise_factor"] = detector.excess_noise_factor
    if detector.saturation_adu < ADC_TOP_ADU or reads > 1:
        stated["saturation_adu"] = min(detector.saturation_adu, ADC_TOP_ADU)
    if detector.read_s is not None:
        stated |= {"coadds": reads, "read_s": detector.read_s}
    if detector.dark_e_per_s:
        stated["dark_e_per_s"] = detector.dark_e_per_s
    return stated
