"""`solvephase` (PyPI) on single frames: Levenberg-Marquardt on modes, and what it calls LIFT.

Its conventions are those of this project: kernel exp(-2πi a·u/λ), optical axis at (N-1)/2, Noll
Zernikes. The settings are the fastest at which its error does not grow: single precision, one sample
per pixel, a relative tolerance of 1e-4 instead of 1e-10, and noise-weighted least squares (on frames
with an AO residual its Poisson loss errs more). Its `LIFT` class offers neither spectral weights
nor NCPAs; the problem that the class sets up is therefore set up here, as its documentation says.
"""

from __future__ import annotations

import numpy as np
import solvephase

from irlos_pipe.optics.fourier_matrices import MAS
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres

PUPIL_SAMPLES = 128
TOLERANCE = 1e-4
NM = 1e-9


class SolvephaseFit:
    """Fits one frame after the other; the model is built once.

    The `settings` have spectrum, plate scale and known wavefront; fitted are Noll 2 to ``modes + 1``, flux
    and background; the `loss` is ``gaussian`` or ``poisson``.
    """

    def __init__(self, settings: PsfSettings, modes: int, read_noise_e: float, loss: str):
        diameter = settings.geometry.diameter_m
        centres = grid_centres(PUPIL_SAMPLES, diameter / PUPIL_SAMPLES)
        pupil = solvephase.Pupil.from_array(
            area_weighted_pupil(settings.geometry, centres), diameter=diameter
        )
        wavelengths_nm, weights = np.array(settings.spectrum, float).T
        self.model = solvephase.FocalPlaneModel(
            pupil,
            wavelengths_nm * NM,
            settings.window,
            pixel_scale=settings.pixel_scale_mas * MAS,
            weights=weights,
            diversity=[_opd_m(pupil, settings.known.total_nm)],
            precision="single",
        )
        self.basis = solvephase.Basis.zernike(pupil, modes, start=2, annular=False)
        self.read_noise_e, self.loss = read_noise_e, loss

    def fit_nm(self, image_e: np.ndarray) -> np.ndarray:
        """Coefficients of one frame [nm RMS], started from zero."""
        weights = solvephase.noise_weights(image_e, self.read_noise_e) if self.loss == "gaussian" else None
        problem = solvephase.FocalPlaneProblem(
            self.model,
            image_e,
            basis=self.basis,
            loss=self.loss,
            weights=weights,
            read_noise=self.read_noise_e,
            fit_background=True,
        )
        return solvephase.solve(problem, method="lm", ftol=TOLERANCE).coefficients / NM


def _opd_m(pupil, zernike_nm: dict[int, float]) -> np.ndarray:
    return sum(
        solvephase.zernike_diversity(pupil, noll, [nm * NM], annular=False)[0]
        for noll, nm in zernike_nm.items()
    )
