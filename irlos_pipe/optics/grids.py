"""Where light is sampled on its way: the pupil, the baselines of the OTF, the colours and pixels.

Physical effects act on these grids, and `psf.PsfModel` propagates between them. Everything is float64;
the propagation chooses its own precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.fourier_matrices import FocalGrid, phasor
from irlos_pipe.optics.pupil import band_limited_pupil, transmitted_cells
from irlos_pipe.optics.zernike import zernike_basis

DARK_BEYOND = 12  # samples outside the rim: the filter's ringing has died out, polynomials would grow


@dataclass(frozen=True)
class PupilGrid:
    geometry: PupilGeometry
    samples: int  # across the diameter
    u_m: np.ndarray  # (n,): coordinates along either axis [m]
    wavelengths_m: torch.Tensor  # (wavelengths, 1, 1)
    # from which the coordinates count, along x and y [m]: the pupil's, unless it is a part of that
    middle_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, geometry: PupilGeometry, samples: int, wavelengths_m: Sequence[float]) -> PupilGrid:
        """Return the grid of a band-limited pupil of a `geometry`, `samples` across, for `wavelengths_m`."""
        return cls(geometry, samples, band_limited_pupil(geometry, samples)[0], _colours(wavelengths_m))

    def at(self, wavelengths_m: torch.Tensor) -> PupilGrid:
        """Return the same samples at other wavelengths, (wavelengths,)."""
        return replace(self, wavelengths_m=_colours(wavelengths_m))

    @property
    def radius_m(self) -> float:
        """Radius of the pupil, the unit of `xy`."""
        return self.geometry.diameter_m / 2

    @property
    def width_m(self) -> float:
        """Width of the grid, a little more than the diameter."""
        return len(self.u_m) * (self.u_m[1] - self.u_m[0])

    @property
    def longest_m(self) -> float:
        """No two points with light are further apart [m]."""
        return self.width_m

    @property
    def lit(self) -> np.ndarray:
        """True where there may be light, (n, n): no huge continuations of polynomials in dark corners."""
        return _mesh(self.geometry, self.samples)[2]

    @property
    def xy(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates in units of the radius, (n, n) each; 0 where there is no light."""
        return _mesh(self.geometry, self.samples)[:2]

    @property
    def light(self) -> float:
        """Scale of amplitudes that makes the light through the clear pupil one, focal grid included."""
        cells = transmitted_cells(self.geometry, self.samples)
        return 1 / (np.sqrt(cells) * (self.u_m[1] - self.u_m[0]) * 2 * self.width_m)

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitude of the pupil as it should be, (n, n)."""
        return np.where(self.lit, band_limited_pupil(self.geometry, self.samples)[1], 0) * self.light

    def modes(self, nolls: Sequence[int]) -> np.ndarray:
        return _modes(self.geometry, self.samples, tuple(nolls))

    @property
    def phase_per_nm(self) -> torch.Tensor:
        """Phase of an OPD [rad/nm], (wavelengths, 1, 1)."""
        return 2 * np.pi * NM / self.wavelengths_m

    def phasor(self, opd_nm: torch.Tensor) -> torch.Tensor:
        """Return ``exp(2πi OPD/λ)``, (wavelengths, n, n), of an OPD (n, n) [nm]."""
        return phasor(self.phase_per_nm * opd_nm)


class Sampling(NamedTuple):
    wavelengths_m: torch.Tensor  # (wavelengths,)
    weights: torch.Tensor  # (wavelengths,): of the photons; their sum is 1
    pixel_scale_mas: torch.Tensor  # scalar: geometric mean of the scales along two orthogonal axes
    # (2,): how much more the image is stretched than its mean, along x rather than y and along the diagonal
    # y = x rather than the other one, see `strained.pixel_map`
    strain: torch.Tensor

    @property
    def strains(self) -> bool:
        """Whether the image is strained, or may be where derivatives are requested."""
        return self.strain.requires_grad or bool(self.strain.any())


@dataclass(frozen=True)
class OtfGrid:
    """Baselines and wavelengths on which OTF factors are evaluated."""

    focal: FocalGrid
    wavelengths_m: torch.Tensor  # (wavelengths, 1, 1)
    mean_m: torch.Tensor  # scalar: mean wavelength of the photons

    @classmethod
    def of(cls, focal: FocalGrid, sampling: Sampling) -> OtfGrid:
        """Return the baselines of the grid `focal`, for the colours of a `sampling`."""
        mean_m = (sampling.wavelengths_m * sampling.weights).sum()
        return cls(focal, _colours(sampling.wavelengths_m), mean_m)

    @cached_property
    def length2_m2(self) -> torch.Tensor:
        """Squared length of the baselines, (p, p//2 + 1)."""
        return torch.as_tensor(self.focal.baseline_x_m[None, :] ** 2 + self.focal.baseline_y_m[:, None] ** 2)

    def path_m(self, x_rad, y_rad) -> torch.Tensor:
        """Scalar product ``b·s`` with the direction (`x_rad`, `y_rad`) on the sky [m], (..., p, p//2 + 1)."""
        along_x, along_y = (torch.as_tensor(b) for b in (self.focal.baseline_x_m, self.focal.baseline_y_m))
        return along_x[None, :] * x_rad + along_y[:, None] * y_rad


class PupilMode(NamedTuple):
    """A Zernike mode of the wavefront [nm], or of the logarithm of the amplitude in the pupil."""

    noll: int
    of_amplitude: bool = False


class Optics(NamedTuple):
    """What effects make of the light path; None where they leave it as it is."""

    # (wavelengths, n, n), complex: amplitude of the pupil, instead of the clear one
    pupil: torch.Tensor | None = None
    transfer: torch.Tensor | None = None  # (wavelengths, p, p//2 + 1): factor of the OTF
    sampling: Sampling | None = None
    # further images of the star with a wavefront of their own, without further copies; all add
    copies: tuple[Optics, ...] = ()
    # modes whose derivative of the focal intensity [1/nm or 1] adds to it, behind OTF factors (wavelengths,
    # p, p//2 + 1) of their own [nm or 1]
    by_mode: tuple[tuple[PupilMode, torch.Tensor], ...] = ()


Change: TypeAlias = "tuple[torch.Tensor | None, torch.Tensor | None, Sampling]"


class Tangents(NamedTuple):
    """Derivatives of `Optics` with respect to effect parameters, parameters first."""

    pupil: Sequence[torch.Tensor] = ()  # (parameters, wavelengths, n, n), or empty
    transfer: Sequence[torch.Tensor | None] = ()
    # of the pupil with respect to parameters of the OTF: positions among these, (wavelengths, n, n)
    pupil_too: Sequence[tuple[int, torch.Tensor]] = ()
    # with respect to parameters of the sampling: of pupil and OTF, None without a change, and of it
    sampling: Sequence[Change] = ()
    copies: tuple[Tangents, ...] = ()  # of each of the copies, with respect to the same parameters
    # of every factor in `Optics.by_mode`, with respect to the parameters of `transfer`
    by_mode: Sequence[Sequence[torch.Tensor]] = ()


class Grids(NamedTuple):
    """Everything that effects need to know of a light path: its grids, nominal sampling, and modes."""

    pupil: PupilGrid
    focal: FocalGrid
    sampling: Sampling
    nolls: tuple[int, ...]


@lru_cache(maxsize=8)
def _mesh(geometry: PupilGeometry, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates in units of the radius, 0 in the dark, and where there may be light."""
    u = band_limited_pupil(geometry, samples)[0] / (geometry.diameter_m / 2)
    x, y = np.meshgrid(u, u)
    lit = np.hypot(x, y) <= 1 + DARK_BEYOND / samples
    return _read_only(x * lit), _read_only(y * lit), _read_only(lit)


@lru_cache(maxsize=32)
def _modes(geometry: PupilGeometry, samples: int, nolls: tuple[int, ...]) -> np.ndarray:
    x, y, lit = _mesh(geometry, samples)
    return _read_only(zernike_basis(nolls, x, y) * lit)


def _read_only(array: np.ndarray) -> np.ndarray:
    """An array that callers can share."""
    array.flags.writeable = False
    return array


def _colours(wavelengths_m) -> torch.Tensor:
    return torch.as_tensor(wavelengths_m, dtype=torch.float64)[:, None, None]
