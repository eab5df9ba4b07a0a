"""Recordings exposed: sub-exposures summed to frames, then read out and written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulator.atmosphere import ResidualScreens, jitter_mas
from simulator.campaign import Scene
from simulator.closed_loop import ClosedLoop
from simulator.imaging import Imager
from simulator.telescope import Telescope, tilt_nm

Residual = type[ResidualScreens] | type[ClosedLoop]


@dataclass(frozen=True)
class RawRecording:
    """What the recorder writes, and the mean wavefront that it saw over the recorded frames.

    Frames are uint16, (frames, rows, columns), the dark is float32; of the wavefront, (n, n) [nm], the
    diversity is excluded.
    """

    frames_adu: np.ndarray
    dark_adu: np.ndarray
    mean_opd_nm: np.ndarray


def record(scene: Scene, telescope: Telescope, residual: Residual = ResidualScreens) -> RawRecording:
    """Return the raw frames of a scene; `residual` says how the AO residual is made."""
    sky_rng, detector_rng = (
        np.random.default_rng(seq) for seq in np.random.SeedSequence(scene.seed).spawn(2)
    )
    images, mean_opd_nm = expose(scene, telescope, sky_rng, residual)
    mean_e = images * scene.photons
    detector = scene.detector
    pedestal_adu = detector.pedestal_map_adu(scene.window_px, detector_rng)
    dark_adu = detector.dark_adu(pedestal_adu, scene.exposure_s, detector_rng)
    for pixel, charge_e in scene.cosmic.charge_e if scene.cosmic else ():
        mean_e[(scene.cosmic.frame, *pixel)] += charge_e
    frames = [detector.read_out(frame_e, pedestal_adu, scene.exposure_s, detector_rng) for frame_e in mean_e]
    return RawRecording(np.array(frames), dark_adu, mean_opd_nm)


def expose(
    scene: Scene, telescope: Telescope, rng: np.random.Generator, residual: Residual = ResidualScreens
) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames (frames, rows, columns), as fractions of the photons, and the mean OPD [nm]."""
    wavelengths_nm, weights = zip(*scene.spectrum(scene.points_per_band), strict=True)
    imager = Imager(telescope, wavelengths_nm, weights, scene.window_px, scene.pixel_scale_mas)
    wavefronts = _Wavefronts(scene, telescope, rng, residual)
    diversity_nm = telescope.opd_nm(scene.diversity_nm)
    recorded = set(scene.exposed.tolist())
    images, opd_sum_nm = [], np.zeros_like(diversity_nm)
    for index in range(max(recorded) + 1):
        sequence_nm = [wavefronts.next_nm() for _ in range(scene.subexposures)]
        if index in recorded:
            images.append(np.mean([imager.image(opd_nm + diversity_nm) for opd_nm in sequence_nm], axis=0))
            opd_sum_nm = opd_sum_nm + np.sum(sequence_nm, axis=0)
    return np.array(images), opd_sum_nm / (scene.frames * scene.subexposures)


class _Wavefronts:
    """Sequence of OPDs without diversity: static and introduced aberrations, residual, image motion."""

    def __init__(self, scene: Scene, telescope: Telescope, rng: np.random.Generator, residual: Residual):
        step_s = scene.exposure_s / scene.subexposures
        steps = (int(scene.exposed.max()) + 1) * scene.subexposures
        self._screens = residual(telescope, scene.seeing_arcsec, step_s, rng)
        self._motion_mas = iter(jitter_mas(scene.jitter_mas, step_s, steps, rng))
        self._static_nm = telescope.opd_nm(scene.ncpa_nm) + telescope.opd_nm({4: scene.introduced_defocus_nm})
        self._tip_tilt = telescope.modes[1:3]

    def next_nm(self) -> np.ndarray:
        tip_tilt_nm = [tilt_nm(motion_mas) for motion_mas in next(self._motion_mas)]
        return self._static_nm + self._screens.next_nm() + np.tensordot(tip_tilt_nm, self._tip_tilt, axes=1)
