"""Fourier matrices between pupil, focal plane, baselines and detector pixels.

The focal grid is tied to the wavelength (pitch λ/2D', D' the width of the pupil grid),
so that one set of matrices serves every wavelength and the baselines of the OTF are the
same for all; only the last step, from the OTF to the detector's pixels, knows the plate
scale. It evaluates the exact Fourier sum at the pixel centres: there is no rounding of
sizes, hence no wavelength-dependent plate scale, and no interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.units import MAS
from irlos_pipe.optics.pupil import CLEAN_BAND, grid_centres


def phasor(phase: torch.Tensor) -> torch.Tensor:
    """``exp(iφ)`` of phases φ [rad]; cosine and sine are computed by vector instructions, it is not."""
    return torch.complex(phase.cos(), phase.sin())


@dataclass(frozen=True)
class FocalGrid:
    """Nyquist-sampled square focal grid of ``samples`` points per axis."""

    samples: int  # computed field
    width_m: float  # width D' of the pupil grid [m]; the pitch is ``λ / (2 D')``
    # samples per axis with the zeros that are appended before OTF factors are applied: the period with
    # which a blur wraps around. Halo that wraps is the first thing to go wrong.
    padded: int
    longest_m: float  # no two points of the pupil are further apart [m]

    @property
    def frequency_per_m(self) -> np.ndarray:
        """Focal coordinate over wavelength, a/λ [1/m]."""
        return grid_centres(self.samples, 1 / (2 * self.width_m))

    @property
    def baseline_y_m(self) -> np.ndarray:
        """Baselines along y in FFT order [m]."""
        return np.fft.fftfreq(self.padded) * 2 * self.width_m

    @property
    def baseline_x_m(self) -> np.ndarray:
        """Non-negative baselines along x, as a real FFT returns them [m]."""
        return np.fft.rfftfreq(self.padded) * 2 * self.width_m


def focal_samples_for(
    window_px: int, pixel_scale_mas: float, margin_mas: float, wavelength_m: float, width_m: float
) -> int:
    """Return the samples of a focal grid that cover a window and a margin on each side.

    The window has `window_px` of `pixel_scale_mas`, the margin is `margin_mas`; the grid is that of a pupil
    grid of `width_m` at `wavelength_m`.
    """
    field_rad = (window_px * pixel_scale_mas + 2 * margin_mas) * MAS
    samples = int(np.ceil(field_rad * 2 * width_m / wavelength_m))
    return samples + (-samples) % 4


def quick_fft_length(samples: int) -> int:
    """Return the next length of which an FFT is quick: a multiple of 8 without prime factors beyond 5."""
    length = samples + (-samples) % 8
    while scipy.fft.next_fast_len(length, real=True) != length:
        length += 8
    return length


def pupil_samples_for(window_px: int, pixel_scale_mas: float, wavelength_m: float, diameter_m: float) -> int:
    """Return the fewest samples across a pupil of `diameter_m` that `require_resolved` accepts.

    The window has `window_px` of `pixel_scale_mas`; `wavelength_m` is the shortest one.
    """
    return int(np.ceil(window_px * pixel_scale_mas * MAS * diameter_m / (CLEAN_BAND * wavelength_m)))


def require_resolved(window_px: int, pixel_scale_mas: float, wavelength_m: float, step_m: float) -> None:
    """Raise a ValueError for a window wider than what the sampled pupil's spectrum is good for.

    Beyond it the low-pass of the pupil, and then its periodic replicas, falsify the image. The window has
    `window_px` of `pixel_scale_mas`; `wavelength_m` is the shortest one, `step_m` that of the pupil grid.
    """
    reach_mas = CLEAN_BAND * wavelength_m / (2 * step_m) / MAS
    if window_px * pixel_scale_mas > 2 * reach_mas:
        needed = window_px * pixel_scale_mas / (2 * reach_mas)
        raise ValueError(
            f"a window of {window_px} px x {pixel_scale_mas} mas is wider than the {2 * reach_mas:.0f} mas "
            f"for which the pupil is sampled at {wavelength_m * 1e9:.0f} nm; "
            f"use at least {needed:.3g} times as many pupil samples"
        )


def baseline_to_pixels(
    baselines_m: np.ndarray,
    pixels: int,
    pixel_scale_mas: float | torch.Tensor,
    wavelength_m: float | torch.Tensor,
    grid: FocalGrid,
    *,
    half: bool,
    slope: bool = False,
) -> torch.Tensor:
    """Return the matrix from FFT coefficients of the focal intensity to pixel-integrated flux.

    Parameters
    ----------
    baselines_m : ndarray
        `FocalGrid.baseline_y_m` or, with ``half=True``, `FocalGrid.baseline_x_m`.
    pixel_scale_mas, wavelength_m : float or scalar tensor
        The matrix is differentiable in both.
    half : bool
        True for the axis of a real FFT: inner coefficients count twice, and the real part
        of the two-axis product is taken.
    slope : bool
        Its derivative with respect to the logarithm of pixel scale over wavelength instead.

    Returns
    -------
    tensor, (pixels, len(baselines_m)), complex128

    Raises
    ------
    ValueError
        If the window is wider than the focal grid, which would alias silently.
    """
    scale, colour = (float(torch.as_tensor(value).detach()) for value in (pixel_scale_mas, wavelength_m))
    require_field(pixels, scale, colour, grid)
    pixel = torch.as_tensor(pixel_scale_mas * MAS / wavelength_m, dtype=torch.float64)  # over baselines
    baselines = torch.as_tensor(baselines_m)
    phase = 2 * np.pi * torch.as_tensor(grid_centres(pixels, 1.0))[:, None] * pixel * baselines
    # The FFT counts from the first sample.
    waves = phasor(phase - 2 * np.pi * grid.frequency_per_m[0] * baselines)
    counts = half_plane_counts(len(baselines_m), grid.padded) if half else np.ones(len(baselines_m))
    coefficient = pixel * torch.as_tensor(counts * 2 * grid.width_m / grid.padded)
    weight = torch.sinc(baselines * pixel)
    if slope:
        edge = torch.cos(np.pi * baselines * pixel).expand_as(phase)
        return waves * coefficient * torch.complex(edge, phase * weight)
    return waves * (coefficient * weight)


def require_field(pixels: int, pixel_scale_mas: float, wavelength_m: float, grid: FocalGrid) -> None:
    """Raise ValueError if a window of `pixels` of `pixel_scale_mas` is wider than the field of a `grid`.

    The field is that at `wavelength_m`.
    """
    field_rad = grid.samples * wavelength_m / (2 * grid.width_m)
    if pixels * pixel_scale_mas * MAS > field_rad:
        raise ValueError(
            f"a window of {pixels} px x {pixel_scale_mas} mas is wider than the computed field of "
            f"{field_rad / MAS:.0f} mas at {wavelength_m * 1e9:.0f} nm: it would alias"
        )


def half_plane_counts(baselines: int, padded: int) -> np.ndarray:
    """How often a real FFT of `padded` samples counts each of its `baselines`: itself and its conjugate."""
    counts = np.full(baselines, 2.0)
    counts[0] = 1
    if padded % 2 == 0:
        counts[-1] = 1
    return counts


def focal_to_pixels(
    pixels: int,
    pixel_scale_mas: float | torch.Tensor,
    wavelength_m: float | torch.Tensor,
    grid: FocalGrid,
    *,
    slope: bool = False,
) -> torch.Tensor:
    """Return the matrix from focal intensity to pixel-integrated flux along one axis, without OTF factors.

    It is (pixels, grid.samples), float64; `pixels`, `pixel_scale_mas`, `wavelength_m`, `grid` and `slope` are
    as of `baseline_to_pixels`.
    """
    to_pixels = baseline_to_pixels(
        grid.baseline_y_m, pixels, pixel_scale_mas, wavelength_m, grid, half=False, slope=slope
    )
    transform = np.fft.fft(np.eye(grid.padded), axis=0)[:, : grid.samples]
    return (to_pixels @ torch.as_tensor(transform)).real
