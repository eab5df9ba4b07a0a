"""A padded-FFT model fitted with automatic differentiation and L-BFGS, as the paper describes DIP.

Written from the paper's text: pupil sampled 127 times across the diameter, zero-padded so that the
FFT's pitch is the detector's at 1600 nm (540 samples), mean absolute error, all frames optimised as
one problem by L-BFGS with a history of 20. Pixels are samples, not areas.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.fourier_matrices import MAS
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres
from irlos_pipe.optics.zernike import zernike_basis

PUPIL_SAMPLES = 127
HISTORY = 20
SCALE_NM = 100.0  # coefficients are optimised in units of this; the line search fails with much smaller ones
MAX_ITERATIONS = 300
WINDOW, RELATIVE_FALL = 10, 1e-3  # stop when the loss falls by less than this over as many iterations


class FftModel:
    """Images by zero-padded FFT, differentiable by autograd; the diversity is by Noll index [nm RMS]."""

    def __init__(
        self,
        geometry: PupilGeometry,
        nolls,
        diversity_nm: dict[int, float],
        wavelength_nm: float,
        pixel_scale_mas: float,
        window_px: int,
    ):
        step_m = geometry.diameter_m / PUPIL_SAMPLES
        self.wavelength_nm, self.window_px = wavelength_nm, window_px
        self.padded = round(wavelength_nm * 1e-9 / (step_m * pixel_scale_mas * MAS))
        u = grid_centres(PUPIL_SAMPLES, step_m)
        x, y = np.meshgrid(u, u) / np.array(geometry.diameter_m / 2)
        half_pixel_nm = 0.5 * wavelength_nm / (self.padded * step_m) * geometry.diameter_m / 2 * (x + y)
        fixed = sum(nm * zernike_basis([noll], x, y)[0] for noll, nm in diversity_nm.items())
        self.amplitude = torch.as_tensor(area_weighted_pupil(geometry, u), dtype=torch.float32)
        self.basis = torch.as_tensor(zernike_basis(nolls, x, y), dtype=torch.float32)
        # The zero frequency is a pixel; half a pixel of tilt brings it between the central four.
        odd_window = window_px % 2
        self.fixed_nm = torch.as_tensor(fixed - (0 if odd_window else half_pixel_nm), dtype=torch.float32)

    def images(self, coefficients_nm: torch.Tensor) -> torch.Tensor:
        """Images of unit total flux, (frames, window, window), from coefficients (frames, modes) [nm]."""
        opd_nm = torch.tensordot(coefficients_nm, self.basis, dims=1) + self.fixed_nm
        field = torch.polar(self.amplitude.expand_as(opd_nm), opd_nm * (2 * np.pi / self.wavelength_nm))
        spectrum = torch.fft.fft2(field, s=(self.padded, self.padded))
        middle, half = self.padded // 2, self.window_px // 2
        cut = slice(middle - half, middle - half + self.window_px)
        intensity = torch.fft.fftshift(spectrum.abs().square(), dim=(1, 2))[:, cut, cut]
        return intensity / (self.amplitude.sum() * self.padded**2)


def fit(model: FftModel, images_e: torch.Tensor) -> tuple[np.ndarray, int]:
    """Coefficients of every frame, (frames, modes) [nm RMS], and evaluations of the loss and its gradient."""
    flux_e = images_e.sum((1, 2), keepdim=True)
    modes = len(model.basis)
    values = torch.zeros(len(images_e), modes + 2, requires_grad=True)

    def loss() -> torch.Tensor:
        unit = model.images(values[:, :modes] * SCALE_NM)
        background = values[:, -1, None, None] / unit[0].numel()
        return ((1 + values[:, -2, None, None]) * unit + background - images_e / flux_e).abs().sum()

    evaluations = _minimise(values, loss)
    return (values.detach()[:, :modes] * SCALE_NM).numpy(), evaluations


def _minimise(values: torch.Tensor, loss) -> int:
    """L-BFGS until the loss no longer falls; returns the number of evaluations."""
    optimiser = torch.optim.LBFGS(
        [values],
        max_iter=WINDOW,
        history_size=HISTORY,
        line_search_fn="strong_wolfe",
        tolerance_change=0.0,
        tolerance_grad=0.0,
    )

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        total = loss()
        total.backward()
        return total

    before = float("inf")
    for _ in range(MAX_ITERATIONS // WINDOW):
        now = optimiser.step(closure).item()  # the loss where the step begins
        if now > before * (1 - RELATIVE_FALL):
            break
        before = now
    return optimiser.state[values]["func_evals"]
