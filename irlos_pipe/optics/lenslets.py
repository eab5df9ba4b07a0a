"""The light path through an array of 2x2 lenslets: four images of the star, each of a quarter of the pupil.

The wavefront is common: Zernike polynomials are those of the whole pupil, so tip and tilt move all images by
the same shift, and defocus moves them away from one another. Every lenslet has its own field stop, the window
of its image; light beyond it is lost, not seen by the neighbour. The four windows lie side by side, lower
left, lower right, upper left, upper right, so an image of the array is (2 rows, 2 columns). Which image
belongs to which quarter of the pupil is a convention of the instrument: here the lower left to the lower
left.

An image does not know where in the pupil its light has passed, so a quarter is sampled about its own middle.
Its grid is about half as wide as the pupil's: its focal grid needs half as many samples per axis, and its OTF
half as many baselines.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.grids import Grids, Optics, PupilGrid, Tangents
from irlos_pipe.optics.light_path import AS_BUILT, NO_TANGENTS, LightPath, Pullback
from irlos_pipe.optics.psf import PsfModel, pupil_grid
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.pupil import Division, band_limited_parts, grid_centres

RINGING = 6  # samples beyond the axes: those left out would change images by 1e-5 of the peak
# In units of the largest amplitude: less than the first is no light, less than the second hardly any.
DARK, FAINT = 1e-12, 0.02
BEYOND = 0.5  # by which the ratio of faint amplitudes may leave 0 to 1, as band-limited ones ring


@dataclass(frozen=True, eq=False, kw_only=True)
class Quarter(PupilGrid):
    """Samples of a quarter of the pupil, about its middle."""

    place: tuple[slice, slice]  # rows and columns of the pupil's grid
    clear: np.ndarray  # (n, n): amplitude of the quarter before its light is counted
    # (n, n): by what to multiply the amplitude of the pupil there to get that of the quarter
    weights: torch.Tensor

    @property
    def amplitude(self) -> np.ndarray:
        return self.clear * self.light

    @property
    def longest_m(self) -> float:
        return float(np.hypot(self.width_m, self.width_m))

    def modes(self, nolls: Sequence[int]) -> np.ndarray:
        return super().modes(nolls)[:, *self.place]

    def through(self, pupil: torch.Tensor | None) -> Any:
        """Return the part of a disturbed `pupil`, if any, from (wavelengths, m, m) to (wavelengths, n, n)."""
        return None if pupil is None else pupil[:, *self.place] * self.weights


def quarters(pupil: PupilGrid) -> list[Quarter]:
    """Return the four quarters of a `pupil`: lower left, lower right, upper left, upper right."""
    drawn = np.where(pupil.lit, _drawn(pupil.geometry, pupil.samples), 0)
    whole, total = pupil.amplitude / pupil.light, len(pupil.u_m)
    size = total // 2 + RINGING
    size += size % 2  # `MatrixDft` folds the grid
    halves = slice(size), slice(total - size, total)
    own = replace(pupil, u_m=grid_centres(size, pupil.u_m[1] - pupil.u_m[0]))
    found = []
    for clear, place in zip(drawn, product(halves, halves), strict=True):
        middle_y, middle_x = (float(pupil.u_m[one].mean()) for one in place)
        weights = _weights(whole, clear)[place] * own.light / pupil.light
        grid = {**vars(own), "middle_m": (middle_x, middle_y)}
        found.append(Quarter(**grid, place=place, clear=clear[place], weights=torch.as_tensor(weights)))
    return found


@lru_cache(maxsize=8)
def _drawn(geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Amplitudes of the quarters of a pupil, (4, n, n), on the grid of `band_limited_pupil`."""
    return band_limited_parts(geometry, samples, Division(lambda x_m, y_m: 2 * (y_m > 0) + (x_m > 0), 4))


def _weights(whole: np.ndarray, part: np.ndarray) -> np.ndarray:
    """By what to multiply an amplitude to get that of a part, (n, n).

    They are ratios of amplitudes: what an effect does to the light of the pupil it does to that of a part.
    Where there is hardly light, the ratio is held near 0 to 1.
    """
    seen = np.abs(whole) > DARK * np.abs(whole).max()
    ratio = np.divide(part, whole, out=np.zeros_like(part), where=seen)
    faint = np.abs(whole) < FAINT * np.abs(whole).max()
    return np.where(faint, ratio.clip(-BEYOND, 1 + BEYOND), ratio)


class LensletArray:
    """A `LightPath` through four lenslets: a `PsfModel` each, of the same grids, with a part of the pupil.

    The `settings` are those of the whole pupil, the window that of the four images side by side; `options`
    are those of `PsfModel`.

    Raises `ValueError` if the window cannot be halved.
    """

    def __init__(self, settings: PsfSettings, nolls: Sequence[int], **options: Any):
        rows, columns = settings.window
        if rows % 2 or columns % 2:
            raise ValueError(f"a window of {rows}x{columns} px has no four equal quarters")
        own = replace(settings, window=settings.lenslet_window, lenslets=1)
        self.pupil = pupil_grid(own)
        self.quarters = quarters(self.pupil)
        self.paths = [PsfModel(own, nolls, grid=quarter, **options) for quarter in self.quarters]
        first = self.paths[0]
        self.settings, self.nolls = settings, first.nolls
        self.device, self.dtype = first.device, first.dtype

    @property
    def grids(self) -> Grids:
        """See `LightPath.grids`: the pupil is the whole one, the baselines are those of a quarter."""
        return self.paths[0].grids._replace(pupil=self.pupil)

    @property
    def limits_nm(self) -> torch.Tensor:
        return self.paths[0].limits_nm

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> LensletArray:
        other, margins = copy(self), (margin_mas, halo_margin_mas)
        other.settings = replace(
            self.settings, window=window, margin_mas=margin_mas, halo_margin_mas=halo_margin_mas
        )
        other.paths = [path.in_window(other.settings.lenslet_window, *margins) for path in self.paths]
        return other

    def images(self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        pairs = zip(self.paths, self._each(optics), strict=True)
        return side_by_side([path.images(modes_nm, own) for path, own in pairs])

    def images_and_jacobian(
        self,
        modes_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        parts = [
            path.images_and_jacobian(modes_nm, own, self._tangents(tangents, lenslet), modal=modal)
            for lenslet, (path, own) in enumerate(zip(self.paths, self._each(optics), strict=True))
        ]
        images, jacobians = zip(*parts, strict=True)
        return side_by_side(images), side_by_side(jacobians)

    def images_and_pullback(
        self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT
    ) -> tuple[torch.Tensor, Pullback]:
        pairs = zip(self.paths, self._each(optics), strict=True)
        images, backs = zip(*(path.images_and_pullback(modes_nm, own) for path, own in pairs), strict=True)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            own = zip(backs, apart(factors), strict=True)
            return sum(back(part.contiguous()) for back, part in own)

        return side_by_side(images), pullback

    # -- what of the light path each lenslet sees ----------------------------------------------

    def _each(self, optics: Optics) -> list[Optics]:
        return [self._own(optics, lenslet) for lenslet in range(len(self.paths))]

    def _own(self, optics: Optics, lenslet: int) -> Optics:
        """What effects make of the light path of one lenslet; the modes of the pupil are none of its own."""
        return Optics(
            self.quarters[lenslet].through(optics.pupil),
            _of(optics.transfer, lenslet),
            optics.sampling,
            tuple(self._own(one, lenslet) for one in optics.copies),
        )

    def _tangents(self, tangents: Tangents, lenslet: int) -> Tangents:
        """Their derivatives for one lenslet."""
        through = self.quarters[lenslet].through
        return Tangents(
            [through(one) for one in tangents.pupil],
            [_slope_of(one, lenslet) for one in tangents.transfer],
            [(place, through(one)) for place, one in tangents.pupil_too],
            [(through(one), _slope_of(other, lenslet), change) for one, other, change in tangents.sampling],
            tuple(self._tangents(one, lenslet) for one in tangents.copies),
        )


def side_by_side(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return the four images, (..., rows, columns), in one, (..., 2 rows, 2 columns)."""
    return torch.cat([torch.cat(list(half), dim=-1) for half in (parts[:2], parts[2:])], dim=-2)


def apart(images: torch.Tensor) -> list[torch.Tensor]:
    """Return the four images, (..., rows, columns), of those side by side, (..., 2 rows, 2 columns)."""
    rows, columns = (size // 2 for size in images.shape[-2:])
    return [images[..., y : y + rows, x : x + columns] for y in (0, rows) for x in (0, columns)]


def light_path(settings: PsfSettings, nolls: Sequence[int], **options: Any) -> LightPath:
    """Return the light path that `settings` ask for, with the modes `nolls` and `options` of `PsfModel`."""
    kind = PsfModel if settings.lenslets == 1 else LensletArray
    return kind(settings, nolls, **options)


def _of(transfer: torch.Tensor | None, lenslet: int) -> torch.Tensor | None:
    """The OTF factor of a lenslet, where effects differ between them."""
    return transfer if transfer is None or transfer.ndim == 3 else transfer[lenslet]


def _slope_of(transfer: torch.Tensor | None, lenslet: int) -> torch.Tensor | None:
    """Its derivative; None where a parameter leaves the lenslet alone."""
    own = _of(transfer, lenslet)
    return None if own is None or not bool(own.any()) else own
