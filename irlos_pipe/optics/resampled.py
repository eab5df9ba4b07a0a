"""Derivatives of the image of one colour while colours or pixels change.

A wavelength acts on the phase, on the size of a pixel in λ/D', and on whatever depends on it in the pupil and
in the OTF; a photon weight scales the image, and the pixel scale is the size of a pixel again. A strain gives
pixels another shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch

from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.focal_intensity import change_of, intensity_of, times_i
from irlos_pipe.optics.grids import Sampling
from irlos_pipe.optics.matrix_dft import MatrixDft
from irlos_pipe.optics.monochromatic import Colour, behind
from irlos_pipe.optics.strained import Strained, pixel_map_slope


class Rates(NamedTuple):
    """How fast one parameter changes what light of one colour meets.

    Attributes
    ----------
    weight, wavelength, scale : float
        Relative to the photon weight, the wavelength and the pixel scale.
    strain : tensor, (2,)
        Of the image, see `Sampling`.
    pupil, transfer : tensor or None
        As of `Colour`.
    """

    weight: float
    wavelength: float
    scale: float
    strain: torch.Tensor
    pupil: torch.Tensor | None
    transfer: torch.Tensor | None

    @classmethod
    def of(cls, sampling: Sampling, change: Sampling, index: int, *factors: torch.Tensor | None) -> Rates:
        """Return those of a `sampling` with a `change` at the wavelength `index`; `factors`: the others."""
        weight, slope = float(sampling.weights[index]), float(change.weights[index])
        return cls(
            slope / weight if weight else 0.0,  # a colour without light stays without
            float(change.wavelengths_m[index] / sampling.wavelengths_m[index]),
            float(change.pixel_scale_mas / sampling.pixel_scale_mas),
            change.strain,
            *factors,
        )


class PixelSlopes(Protocol):
    """Derivatives of weighted images while pixels change."""

    def __call__(
        self, intensity: torch.Tensor, image: torch.Tensor, every: Sequence[Rates]
    ) -> list[torch.Tensor]:
        """Return those of the `image` of a focal `intensity`, (frames, rows, columns) for each of `every`."""


class SquarePixels:
    """Derivatives while pixels stay squares.

    Parameters
    ----------
    colour : Colour
    rows, columns : tensor
        See `FocalPlane.pixel_slopes`.
    """

    def __init__(self, colour: Colour, rows: torch.Tensor, columns: torch.Tensor):
        self._along = colour._replace(to_rows=rows), colour._replace(to_columns=columns)

    def __call__(
        self, intensity: torch.Tensor, image: torch.Tensor, every: Sequence[Rates]
    ) -> list[torch.Tensor]:
        """See `PixelSlopes`."""
        wider = self._along[0].image(intensity) + self._along[1].image(intensity)
        return [(rates.scale - rates.wavelength) * wider for rates in every]


class SkewPixels:
    """Derivatives while pixels become parallelograms.

    Parameters
    ----------
    colour : Colour
    strained : Strained
    strain : tensor, (2,)
        At which they are.
    """

    def __init__(self, colour: Colour, strained: Strained, strain: torch.Tensor):
        self._colour, self._strained, self._strain = colour, strained, strain.detach()

    def __call__(
        self, intensity: torch.Tensor, image: torch.Tensor, every: Sequence[Rates]
    ) -> list[torch.Tensor]:
        """See `PixelSlopes`; a pixel that is larger by a factor shows its square times the light."""
        larger = [rates.scale - rates.wavelength for rates in every]
        changes = [
            factor * self._strained.pixels.map + pixel_map_slope(self._strain, rates.strain)
            for factor, rates in zip(larger, every, strict=True)
        ]
        slopes = self._strained.slopes(self._colour.waves(intensity), changes)
        return [2 * factor * image + slope for factor, slope in zip(larger, slopes, strict=True)]


def resampled(
    colour: Colour, dft: MatrixDft, by_pixels: PixelSlopes, opd_nm: torch.Tensor, every: Sequence[Rates]
) -> torch.Tensor:
    """Return derivatives of weighted images at one wavelength, (parameters, frames, rows, columns).

    Parameters
    ----------
    colour : Colour
    dft : MatrixDft
        To its focal plane.
    by_pixels : PixelSlopes
    opd_nm : tensor, (frames, n, n)
    every : sequence of Rates
        One per parameter.
    """
    phasor = colour.phasor(opd_nm)
    field = behind(colour.pupil, phasor)
    amplitude = dft.amplitude(field)
    intensity = intensity_of(amplitude)
    image = colour.image(intensity)
    turned = times_i(field)
    phase = (opd_nm * (2 * np.pi * NM / colour.wavelength_m))[:, None]
    found = []
    for rates, pixels in zip(every, by_pixels(intensity, image, every), strict=True):
        slope = rates.weight * image + pixels
        moved = -rates.wavelength * phase * turned
        if rates.pupil is not None:
            moved = moved + behind(rates.pupil, phasor)
        if rates.wavelength or rates.pupil is not None:
            slope = slope + colour.image(change_of(amplitude, dft.amplitude(moved)))
        if rates.transfer is not None:
            slope = slope + colour.images_through([intensity], [[rates.transfer]])[0]
        found.append(slope)
    return torch.stack(found)
