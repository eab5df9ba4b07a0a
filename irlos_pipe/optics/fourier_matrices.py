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

    It is (pixels, baselines), complex128, and differentiable in `pixel_scale_mas` and `wavelength_m`. The
    `baselines_m` are `FocalGrid.baseline_y_m`, or `FocalGrid.baseline_x_m` with `half`, for the axis of a
    real FFT: inner coefficients count twice, and the real part of the two-axis product is taken. With
    `slope` it is the derivative with respect to the logarithm of pixel scale over wavelength instead.

    Raises `ValueError` if the window is wider than the focal grid, which would alias silently.
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


def mirrored(array: torch.Tensor) -> torch.Tensor:
    """A map (..., n, n) with both axes in mirrored order: the positive half outwards, then the negative one.

    Field arithmetic does not care about the order of samples, and even and odd parts of mirrored maps are
    sums and differences of their halves.
    """
    half = array.shape[-1] // 2
    order = torch.tensor([*range(half, 2 * half), *reversed(range(half))], device=array.device)
    return array.index_select(-1, order).index_select(-2, order)


def products_up_to(degree: int) -> list[tuple[int, int]]:
    """Degrees (a, b) along x and y of all products up to a total degree: even sums first, then odd ones."""
    return [
        (a, b)
        for parity in (0, 1)
        for b in range(degree + 1)
        for a in range((b + parity) % 2, degree + 1 - b, 2)
    ]


class MatrixDft:
    """Transform of fields, and of fields times products of polynomials ``T_a(x) T_b(y)``.

    Fields are real arrays (frames, 2, n, n), real part and imaginary part, in `mirrored` order; focal
    amplitudes are (frames, 2, m, m) in natural order. The `u_m`, (n,), are samples of the pupil along either
    axis [m], n even; the `polynomials`, (degree + 1, n), are T_0 = 1, T_1, … there, by turns even and odd.
    The precision and device are those of `like`.
    """

    def __init__(self, u_m: np.ndarray, grid: FocalGrid, polynomials: np.ndarray, like: torch.Tensor):
        half, step_m = len(u_m) // 2, u_m[1] - u_m[0]
        phase = 2 * np.pi * np.outer(u_m[half:], grid.frequency_per_m)
        cosine, sine = step_m * np.cos(phase), step_m * np.sin(phase)
        even, odd = np.concatenate([cosine, sine]), np.concatenate([-sine, cosine])  # (n, m)
        weights = np.tile(polynomials[:, half:], 2)[:, :, None]
        along_x = np.stack([w * (odd if a % 2 else even) for a, w in enumerate(weights)])
        self.along_x = torch.as_tensor(along_x).to(like)  # (degree + 1, n, m)
        self.along_y = self.along_x.mT.contiguous()

    def amplitude(self, field: torch.Tensor) -> torch.Tensor:
        """Return the focal amplitude ``F E Fᵀ``."""
        return self.along_y[0] @ (_packed(field) @ self.along_x[0])

    def adjoint(self, amplitude: torch.Tensor) -> torch.Tensor:
        """Return the transpose of `amplitude` as a real linear map: from changes of U to changes of E."""
        return _unpacked(self.along_x[0] @ (amplitude @ self.along_y[0]))

    def products(self, field: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the transforms ``F[T_a(x) T_b(y) E]`` in the order of `products_up_to`: even sums, odd sums.

        Either is (products, frames, 2, m, m), times -1 where a and b are odd, times -i where one of them is.
        """
        packed = _packed(field).flatten(0, 1)
        rows = packed.flatten(0, 1)
        along_x = [
            torch.bmm(rows.expand(len(matrices), -1, -1), matrices).unflatten(1, packed.shape[:2])
            for matrices in (self.along_x[0::2], self.along_x[1::2])
        ]
        return self._along_y(along_x, 0), self._along_y(along_x, 1)

    def _along_y(self, along_x: list[torch.Tensor], parity: int) -> torch.Tensor:
        """Products with an even or odd sum of degrees, from the transforms along x by parity."""
        top, images, m = len(self.along_y), along_x[0].shape[1], along_x[0].shape[3]
        counts = [len(range((b + parity) % 2, top - b, 2)) for b in range(top)]
        products = along_x[0].new_empty(sum(counts), images, m, m)
        for b, (count, block) in enumerate(zip(counts, products.split(counts), strict=True)):
            fields = along_x[(b + parity) % 2][:count].flatten(0, 1)
            torch.bmm(self.along_y[b].expand(len(fields), -1, -1), fields, out=block.flatten(0, 1))
        return products.unflatten(1, (-1, 2))


def _packed(field: torch.Tensor) -> torch.Tensor:
    """Parts of a field E whose real transform is Re U, and those for Im U, (frames, 2, n, n).

    Even and odd along y by even and odd along x: ``[[Re, Im], [Im, -Re]]`` of E, and the same of -iE.
    """
    (pp, pn), (np_, nn) = _quadrants(field)
    same, opposite = pp + nn, pn + np_  # signs of the coordinates
    across, along = pp - nn, pn - np_
    odd_even, even_odd = _turned(across + along), _turned(across - along)
    return _joined(same + opposite, even_odd, odd_even, opposite - same)


def _unpacked(packed: torch.Tensor) -> torch.Tensor:
    (even_even, even_odd), (odd_even, odd_odd) = _quadrants(packed)
    same, opposite = even_even - odd_odd, even_even + odd_odd
    across, along = _turned(even_odd + odd_even), _turned(odd_even - even_odd)
    return _joined(same - across, opposite - along, opposite + along, same + across)


def _turned(field: torch.Tensor) -> torch.Tensor:
    return torch.stack([field[:, 1], -field[:, 0]], dim=1)


def _quadrants(array: torch.Tensor) -> list[tuple[torch.Tensor, ...]]:
    """Quarters of maps (..., n, n), by halves along y and along x."""
    return [rows.tensor_split(2, dim=-1) for rows in array.tensor_split(2, dim=-2)]


def _joined(pp: torch.Tensor, pn: torch.Tensor, np_: torch.Tensor, nn: torch.Tensor) -> torch.Tensor:
    return torch.cat([torch.cat([pp, pn], dim=-1), torch.cat([np_, nn], dim=-1)], dim=-2)
