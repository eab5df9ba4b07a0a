"""Images of wavefronts that differ by tip, tilt and one more mode, from a table.

Tip and tilt of the wavefront shift the image at every wavelength by the same angle. What is left of such a
family of images is its course with the third mode, here called focus, with AO residual, image motion,
dispersion and all colours in it. It is tabulated once, on pixels somewhat beyond the window::

    I(y, x; d) = Σ_n T_n(d) C_n(y, x)                   Chebyshev series in the focus d
    image      = S(y₀) I(d) S(x₀)ᵀ                      shifted by band-limited interpolation

Derivatives are those of T_n and of S. An image costs one product with the table and two small matrix
products, whatever the number of wavelengths. Where the image is strained, tip shifts it along y, too.

Focus changes the phase between two points of the pupil by up to ``β = 2π R P/λ``, R being half the range and
P the mode's peak-to-valley. The coefficients of ``exp(iβx)`` are Bessel functions of the order n, which
fall faster than exponentially beyond n = β (Jacobi–Anger): the series ends where they no longer matter.

An image without frequencies beyond f (cycles per pixel, f < ½) is interpolated exactly by any kernel whose
spectrum is one up to f and zero from 1 - f on, where the replicas of the sampled image begin. The gentler the
way down between the two, the faster the kernel falls off. Here it is a Kaiser-windowed sinc with the ripples
of its spectrum ironed out, given by its cosine series; the derivative of a shift is exact.

Reference: Kaiser & Schafer 1980, IEEE Trans. ASSP 28, 105 (length and attenuation of the window).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from scipy.special import jv

from irlos_pipe.conventions.units import NM, cutoff_per_px, tilt_nm
from irlos_pipe.numerics.parallel import at_once
from irlos_pipe.optics.defocus import shaped_modes
from irlos_pipe.optics.grids import Optics, Tangents
from irlos_pipe.optics.light_path import AS_BUILT, NO_TANGENTS, LightPath, Pullback
from irlos_pipe.optics.strained import pixel_map

ATTENUATION_DB = 100.0  # of what the kernel has left beyond its half length
TRUNCATION = 1e-7  # the largest Bessel function left out
WELL_SAMPLED = 0.4  # highest frequency of the images [cycles/px] that short kernels can shift
FIELD_MARGIN_MAS = 50.0  # of the computed field beyond the tabulated pixels
NODES_AT_ONCE = 6  # images propagated together: few enough for the processor's cache
OPEN_END = 1.001  # half range of the series over the half range offered: its slope is 0/0 at its very ends


def kernel_half_length(band: float) -> int:
    """Pixels on either side that a kernel needs for images without frequencies beyond `band` [1/px]."""
    return int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * (1 - 2 * band)) / 2))


class ShiftMatrices:
    """Matrices from samples of an image, reversed along both axes, to rows and columns of the shifted window.

    The samples are those of the `window` (rows, columns) and `beyond` further ones on each side. The images
    have no frequency above `band` [cycles/px]; `per_px` units of a shift make a pixel. The matrices have the
    precision and device of `like`.
    """

    def __init__(self, window: tuple[int, int], beyond: int, band: float, per_px: float, like: torch.Tensor):
        self.window, self.beyond = window, beyond
        period = max(window) + 2 * beyond
        frequency = np.arange(int((1 - band) * period) + 1) / period
        rate = 2 * np.pi * frequency
        phase = np.outer(rate, np.arange(1 - max(window) - beyond, max(window) + beyond))
        cosine, sine = _spectrum(frequency, band)[:, None] * (np.cos(phase), np.sin(phase))
        slopes = np.concatenate([rate[:, None] * sine, -rate[:, None] * cosine]) / per_px
        series = np.concatenate([np.concatenate([cosine, sine]), slopes], axis=1)
        self.rate = torch.as_tensor(rate / per_px, device=like.device)
        self.series = torch.as_tensor(series).to(like)

    def __call__(self, shifts: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return matrices for rows and for columns, (images, 2 pixels, samples), derivatives behind values.

        The `shifts`, (images, 2) in float64, are along x and y, positive towards larger indices.
        """
        phase = shifts[..., None] * self.rate
        kernels = torch.cat([phase.cos(), phase.sin()], dim=2).to(self.series.dtype) @ self.series
        along_x, along_y = kernels.unflatten(2, (2, -1)).unbind(1)
        return self._matrices(along_y, self.window[0]), self._matrices(along_x, self.window[1])

    def _matrices(self, kernels: torch.Tensor, pixels: int) -> torch.Tensor:
        """Toeplitz matrices of kernels (images, 2, values) that reach over the longer side of the window."""
        own = kernels[:, :, max(self.window) - pixels :]
        return own.unfold(2, pixels + 2 * self.beyond, 1)[:, :, :pixels].flatten(1, 2)


def _spectrum(frequency: np.ndarray, band: float) -> np.ndarray:
    """Weights of the cosine series of the kernel, whose period is that of the first frequency."""
    length = kernel_half_length(band)
    x = np.linspace(-length, length, 16 * length + 1)
    beta = 0.1102 * (ATTENUATION_DB - 8.7)
    kernel = np.sinc(x) * np.kaiser(len(x), beta)
    smooth = np.cos(2 * np.pi * np.outer(frequency, x)) @ kernel * (x[1] - x[0])
    exact = np.where(frequency <= band, 1.0, np.where(frequency >= 1 - band, 0.0, smooth))
    counts = np.where(frequency > 0, 2.0, 1.0)
    return counts * exact * frequency[1]


@dataclass(frozen=True)
class Reach:
    """Wavefronts that a table holds [nm RMS]: least and largest focus, and tip and tilt either way."""

    focus_nm: tuple[float, float]
    tilt_nm: float


class FocusTable:
    """A `LightPath` with three modes: tip, tilt and one more, called focus.

    It tabulates images of `psf`, see `is_family` and `can_tabulate`, with what `optics` make of its light
    path. Beyond the `reach` images mean nothing; solvers keep to `limits_nm`.
    """

    def __init__(self, psf: LightPath, optics: Optics, reach: Reach):
        self.settings, self.nolls, self.device, self.dtype = psf.settings, psf.nolls, psf.device, psf.dtype
        self.grids, self.reach, self._tabulated = psf.grids, reach, (psf, optics)
        self.tilts, self.focus = [self.nolls.index(2), self.nolls.index(3)], place_of_focus(self.nolls)
        seen, window = _Seen.of(psf, optics), self.settings.window
        beyond, like = seen.pixels_beyond(reach), torch.empty(0, dtype=self.dtype, device=self.device)
        self.shift = ShiftMatrices(window, beyond, seen.band, seen.pixel_nm, like)
        self._stretch = seen.stretch.to(self.device)
        self.middle_nm = float(np.mean(reach.focus_nm))
        self.half_nm = float(OPEN_END * np.ptp(reach.focus_nm) / 2)
        # Further pixels on each side, and margins that leave the period of the OTF factors.
        settings, more_mas = psf.settings, beyond * psf.settings.pixel_scale_mas
        margin_mas = max(settings.margin_mas - more_mas, FIELD_MARGIN_MAS)
        further = window[0] + 2 * beyond, window[1] + 2 * beyond
        wide = psf.in_window(further, margin_mas, settings.halo_margin_mas - more_mas)
        self._tabulate(wide, optics, seen.shortest_m)

    def _tabulate(self, wide: LightPath, optics: Optics, shortest_m: float) -> None:
        """Chebyshev coefficients (terms, pixels), reversed along both axes as in `ShiftMatrices`."""
        grid, noll = wide.grids.pupil, self.nolls[self.focus]
        mode = shaped_modes(grid, [noll], wide.settings.focus_sine)[0][np.hypot(*grid.xy) <= 1]
        phase = 2 * np.pi * NM / shortest_m * self.half_nm * np.ptp(mode)
        orders = np.arange(int(2 * phase) + 40)
        terms = int(orders[np.abs(jv(orders, phase)) > TRUNCATION].max()) + 1
        angle = np.pi * (np.arange(terms) + 0.5) / terms
        nodes_nm = torch.zeros(terms, len(self.nolls), dtype=torch.float64)
        nodes_nm[:, self.focus] = torch.as_tensor(self.middle_nm + self.half_nm * np.cos(angle))
        parts = nodes_nm.split(at_once(NODES_AT_ONCE, self.device))
        images = torch.cat([wide.images(part, optics) for part in parts])
        to_series = np.cos(np.outer(np.arange(terms), angle)) * np.where(np.arange(terms) > 0, 2, 1)[:, None]
        series = torch.as_tensor(to_series / terms, device=self.device) @ images.flatten(1).double()
        self.table, self.shape = series.flip(1).to(self.dtype), images.shape[1:]
        self.orders = torch.arange(terms, device=self.device, dtype=torch.float64)

    # -- LightPath ---------------------------------------------------------------------------

    @property
    def limits_nm(self) -> torch.Tensor:
        """See `LightPath.limits_nm`: what the table holds."""
        limits = torch.full((2, len(self.nolls)), self.reach.tilt_nm, dtype=torch.float64)
        limits[0] *= -1
        limits[:, self.focus] = torch.tensor(self.reach.focus_nm, dtype=torch.float64)
        return limits

    def images(self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        """See `LightPath.images`; `optics` are in the table already."""
        x, (height, width) = modes_nm.to(self.device, torch.float64), self.settings.window
        rows, columns = self.shift(x[:, self.tilts] @ self._stretch)
        weights = (self._angle(x) * self.orders).cos().to(self.dtype)
        images = (weights @ self.table).view(-1, *self.shape)
        return torch.bmm(rows[:, :height], torch.bmm(images, columns[:, :width].mT))

    @torch.no_grad()
    def images_and_jacobian(
        self,
        modes_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `LightPath.images_and_jacobian`; there are no parameters but the modes."""
        x, (height, width) = modes_nm.to(self.device, torch.float64), self.settings.window
        rows, columns = self.shift(x[:, self.tilts] @ self._stretch)
        angle = self._angle(x)
        multiples = angle * self.orders
        steepness = self.orders * multiples.sin() / (angle.sin() * self.half_nm)
        weights = torch.cat([multiples.cos(), steepness]).to(self.dtype)
        images, slopes = (weights @ self.table).view(2, -1, *self.shape)  # before the shift, and by the focus
        along_x = torch.bmm(images, columns.mT)  # shifted, and the derivative of that
        both = torch.bmm(rows, along_x[:, :, :width])
        jacobian = both.new_empty(len(x), 3, height, width)
        moved = torch.bmm(rows[:, :height], along_x[:, :, width:]), both[:, height:]
        for tilt, (by_x, by_y) in zip(self.tilts, self._stretch.tolist(), strict=True):
            jacobian[:, tilt] = by_x * moved[0] + by_y * moved[1]
        jacobian[:, self.focus] = torch.bmm(rows[:, :height], torch.bmm(slopes, columns[:, :width].mT))
        return both[:, :height], jacobian[:, : 3 * modal]

    def images_and_pullback(
        self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT
    ) -> tuple[torch.Tensor, Pullback]:
        images, jacobian = self.images_and_jacobian(modes_nm)
        return images, lambda factors: (jacobian * factors[:, None]).sum((2, 3))

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> FocusTable:
        psf, optics = self._tabulated
        return FocusTable(psf.in_window(window, margin_mas, halo_margin_mas), optics, self.reach)

    def _angle(self, x: torch.Tensor) -> torch.Tensor:
        """The focus as θ, ``T_n = cos nθ``, (images, 1)."""
        return ((x[:, self.focus, None] - self.middle_nm) / self.half_nm).acos()


def is_family(nolls: tuple[int, ...]) -> bool:
    """Return whether modes are tip, tilt and one more."""
    return len(nolls) == 3 and {2, 3} < {*nolls}


def place_of_focus(nolls: tuple[int, ...]) -> int:
    """Return the position of the mode that is neither tip nor tilt."""
    (place,) = (place for place, noll in enumerate(nolls) if noll not in (2, 3))
    return place


def can_tabulate(psf: LightPath, optics: Optics, reach: Reach) -> bool:
    """Return whether the images of `psf` with its `optics` can be tabulated within a `reach`.

    They must be well sampled, and the shifts must fit into the field.
    """
    seen, room_mas = _Seen.of(psf, optics), psf.settings.halo_margin_mas - FIELD_MARGIN_MAS
    if seen.band > WELL_SAMPLED:
        return False
    return seen.pixels_beyond(reach) * psf.settings.pixel_scale_mas <= room_mas


class _Seen(NamedTuple):
    """How the pixels see the light of a path."""

    shortest_m: float  # wavelength
    stretch: torch.Tensor  # of an image, a symmetric matrix (2, 2)
    pixel_nm: float  # tip or tilt that moves an image by a pixel [nm RMS]
    band: float  # highest frequency of the images [cycles/px]

    @classmethod
    def of(cls, psf: LightPath, optics: Optics) -> _Seen:
        sampling, diameter_m = optics.sampling or psf.grids.sampling, psf.settings.geometry.diameter_m
        shortest_m, pixel_mas = float(sampling.wavelengths_m.min()), float(sampling.pixel_scale_mas)
        stretch = pixel_map(-sampling.strain.detach())
        smallest = float(torch.linalg.eigvalsh(stretch).min())
        band = cutoff_per_px(shortest_m, diameter_m, pixel_mas) / smallest
        return cls(shortest_m, stretch, tilt_nm(pixel_mas, diameter_m), band)

    def pixels_beyond(self, reach: Reach) -> int:
        """Pixels that are tabulated on each side of the window."""
        farthest_nm = reach.tilt_nm * float(self.stretch.abs().sum(1).max())
        return int(np.ceil(farthest_nm / self.pixel_nm)) + kernel_half_length(self.band)


class FocusImages:
    """Unit-flux images of a `FocusTable` on the CPU, and their derivatives by tip, tilt and focus."""

    def __init__(self, table: FocusTable):
        self.window = table.settings.window
        order = [*table.tilts, table.focus]
        # (2, 3): least and largest tip, tilt and focus [nm RMS]
        self.limits_nm = table.limits_nm.numpy()[:, order]
        self._middle_nm, self._half_nm = table.middle_nm, table.half_nm
        self._table, self._orders = np.ascontiguousarray(table.table.numpy()), table.orders.numpy()
        self._rate, self._series = table.shift.rate.numpy(), table.shift.series.numpy()
        height, width = self.window
        tall, wide = table.shape
        self._images = np.empty((2, tall * wide), np.float32)
        self._rows = np.empty((2, height, tall), np.float32)
        self._columns = np.empty((2, width, wide), np.float32)
        self._along_x = np.empty((tall, 2 * width), np.float32)
        self._slope_along_x = np.empty((tall, width), np.float32)
        # The last image computed and its derivatives with respect to tip, tilt and focus [1/nm]; those of the
        # next one take their places.
        self.slopes = np.empty((3, height * width), np.float32)
        self.image = np.empty(height * width, np.float32)
        self._shape, self._longer = (tall, wide), max(self.window)

    def __call__(self, tip_nm: float, tilt_nm: float, focus_nm: float) -> None:
        """Compute `image` and `slopes` of a wavefront within `limits_nm` [nm RMS]."""
        self._shift(tip_nm, tilt_nm)
        np.matmul(self._weights(focus_nm), self._table, out=self._images)
        image, slope = self._images.reshape(2, *self._shape)
        rows, steeper_rows = self._rows
        columns = self._columns.reshape(-1, self._shape[1])
        width = self.window[1]
        np.matmul(image, columns.T, out=self._along_x)
        np.matmul(slope, self._columns[0].T, out=self._slope_along_x)
        by_tip, by_tilt, by_focus = self.slopes.reshape(3, *self.window)
        np.matmul(rows, self._along_x[:, :width], out=self.image.reshape(self.window))
        np.matmul(rows, self._along_x[:, width:], out=by_tip)
        np.matmul(steeper_rows, self._along_x[:, :width], out=by_tilt)
        np.matmul(rows, self._slope_along_x, out=by_focus)

    def _weights(self, focus_nm: float) -> np.ndarray:
        """Chebyshev polynomials of the focus and their derivatives, (2, terms)."""
        angle = np.arccos((focus_nm - self._middle_nm) / self._half_nm)
        multiples = angle * self._orders
        steepness = self._orders * np.sin(multiples) / (np.sin(angle) * self._half_nm)
        return np.array([np.cos(multiples), steepness], np.float32)

    def _shift(self, tip_nm: float, tilt_nm: float) -> None:
        """Matrices of the shift along both axes, each followed by its derivative, see `ShiftMatrices`."""
        phase = np.array([[tip_nm], [tilt_nm]]) * self._rate
        basis = np.concatenate([np.cos(phase), np.sin(phase)], axis=1).astype(np.float32)
        along_x, along_y = (basis @ self._series).reshape(2, 2, -1)
        self._fill(self._rows, along_y)
        self._fill(self._columns, along_x)

    def _fill(self, matrices: np.ndarray, kernels: np.ndarray) -> None:
        """Toeplitz matrices of kernels (2, values) that reach over the longer side of the window."""
        _, pixels, samples = matrices.shape
        own = kernels[:, self._longer - pixels :]
        step = own.strides[1]
        matrices[...] = as_strided(own, (2, pixels, samples), (own.strides[0], step, step))
