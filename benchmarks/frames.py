"""Monochromatic calibration frames with known truth, drawn by the simulator of ``data_samples``.

The simulator shares no code with any of the implementations that are timed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SAMPLES = Path(__file__).parents[1] / "data_samples"
WAVELENGTH_NM = 1600.0
WINDOW_PX, PIXEL_SCALE_MAS = 64, 9.7
READ_NOISE_E = 1.0
SUBEXPOSURES = 5  # of the AO residual and the image motion within a frame
NOLLS = tuple(range(2, 31))
DIVERSITY_NM = {6: -170.0}
SEED = 17


@dataclass(frozen=True)
class BenchFrames:
    """Frames and what an estimate is compared with.

    Attributes
    ----------
    images_e : ndarray, (frames, rows, columns), float32
        Photo-electrons, background subtracted.
    truth_nm : ndarray, (frames, modes)
        Least-squares coefficients of `NOLLS` of the wavefront averaged over each frame [nm RMS].
    """

    images_e: np.ndarray
    truth_nm: np.ndarray

    def first(self, count: int) -> BenchFrames:
        """The first `count` frames."""
        return BenchFrames(self.images_e[:count], self.truth_nm[:count])

    def error_nm(self, estimates_nm: np.ndarray) -> float:
        """Total RMS over the modes of the mean estimate of the first frames against their mean truth."""
        difference = np.nanmean(estimates_nm, axis=0) - self.truth_nm[: len(estimates_nm)].mean(axis=0)
        return float(np.sqrt(np.sum(difference**2)))


def draw(count: int, progress=iter) -> BenchFrames:
    """Draw frames of 0.1 s under the conditions of ``data_samples/calibration-sky``, at one wavelength.

    Parameters
    ----------
    progress : callable
        Wraps the iterable of frame numbers, for a progress bar.
    """
    simulator = _Simulator(count)
    drawn = [simulator.frame() for _ in progress(range(count))]
    return BenchFrames(*(np.stack(part) for part in zip(*drawn, strict=True)))


class _Simulator:
    """One sequence of frames."""

    def __init__(self, count: int):
        if str(SAMPLES) not in sys.path:
            sys.path.insert(0, str(SAMPLES))
        from simulator import atmosphere, campaign, imaging, telescope

        scene, step_s = campaign.CALIBRATION, campaign.CALIBRATION.exposure_s / SUBEXPOSURES
        self.rng = np.random.default_rng(SEED)
        self.flux_e = scene.photons
        self.telescope = telescope.build_telescope()
        self.imager = imaging.Imager(self.telescope, [WAVELENGTH_NM], [1.0], WINDOW_PX, PIXEL_SCALE_MAS)
        self.screens = atmosphere.ResidualScreens(self.telescope, scene.seeing_arcsec, step_s, self.rng)
        motion_mas = atmosphere.jitter_mas(scene.jitter_mas, step_s, count * SUBEXPOSURES, self.rng)
        self.tilts_nm = iter([[telescope.tilt_nm(angle) for angle in pair] for pair in motion_mas])
        self.static_nm = self.telescope.opd_nm(scene.ncpa_nm)
        self.stated_nm = np.array([scene.ncpa_nm.get(noll, 0.0) for noll in NOLLS])
        self.diversity_nm = self.telescope.opd_nm(DIVERSITY_NM)

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Image [e-] and true coefficients [nm] of the next frame."""
        opds_nm = [self._next_opd_nm() for _ in range(SUBEXPOSURES)]
        clean = np.mean([self.imager.image(opd + self.diversity_nm) for opd in opds_nm], axis=0) * self.flux_e
        noisy = self.rng.poisson(clean) + self.rng.normal(0.0, READ_NOISE_E, clean.shape)
        return noisy.astype(np.float32), self._true_nm(np.mean(opds_nm, axis=0))

    def _next_opd_nm(self) -> np.ndarray:
        tilt_nm = np.tensordot(next(self.tilts_nm), self.telescope.modes[1:3], axes=1)
        return self.static_nm + self.screens.next_nm() + tilt_nm

    def _true_nm(self, opd_nm: np.ndarray) -> np.ndarray:
        """What `Telescope.fit_zernike_nm` of the simulator returns, with the normal matrix kept."""
        if not hasattr(self, "_normal"):
            modes = self.telescope.modes[: NOLLS[-1] + 1].reshape(NOLLS[-1] + 1, -1)
            self._weighted = modes * self.telescope.transmission.ravel()
            self._normal = self._weighted @ modes.T
        rest_nm = (opd_nm - self.static_nm).ravel()
        return self.stated_nm + np.linalg.solve(self._normal, self._weighted @ rest_nm)[1 : NOLLS[-1]]
