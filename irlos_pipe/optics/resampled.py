"""Derivatives of the image of one colour while colours or pixels change.

A wavelength acts on the phase, on the size of a pixel in λ/D', and on whatever depends on it in the pupil and
in the OTF; a photon weight scales the image, and the pixel scale is the size of a pixel again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.focal_plane import Matrices
from irlos_pipe.optics.grids import Sampling
from irlos_pipe.optics.matrix_dft import MatrixDft
from irlos_pipe.optics.monochromatic import Colour, behind


class Rates(NamedTuple):
    """How fast one parameter changes what light of one colour meets.

    Attributes
    ----------
    weight, wavelength, scale : float
        Relative to the photon weight, the wavelength and the pixel scale.
    pupil, transfer : tensor or None
        As of `Colour`.
    """

    weight: float
    wavelength: float
    scale: float
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
            *factors,
        )


def resampled(
    colour: Colour, dft: MatrixDft, pixel_slopes: Matrices, opd_nm: torch.Tensor, every: Sequence[Rates]
) -> torch.Tensor:
    """Return derivatives of weighted images at one wavelength, (parameters, frames, rows, columns).

    Parameters
    ----------
    colour : Colour
    dft : MatrixDft
        To its focal plane.
    pixel_slopes : Matrices
        See `FocalPlane.pixel_slopes`.
    opd_nm : tensor, (frames, n, n)
    every : sequence of Rates
        One per parameter.
    """
    phasor = colour.phasor(opd_nm)
    field = behind(colour.pupil, phasor)
    amplitude = dft.amplitude(field)
    intensity = amplitude.square().sum(1)
    image, (rows, columns) = colour.image(intensity), pixel_slopes
    wider = colour._replace(to_rows=rows).image(intensity) + colour._replace(to_columns=columns).image(
        intensity
    )
    turned = torch.stack([-field[:, 1], field[:, 0]], dim=1)  # i E
    phase = (opd_nm * (2 * np.pi * NM / colour.wavelength_m))[:, None]
    found = []
    for rates in every:
        slope = rates.weight * image + (rates.scale - rates.wavelength) * wider
        moved = -rates.wavelength * phase * turned
        if rates.pupil is not None:
            moved = moved + behind(rates.pupil, phasor)
        if rates.wavelength or rates.pupil is not None:
            slope = slope + colour.image(2 * (amplitude * dft.amplitude(moved)).sum(1))
        if rates.transfer is not None:
            slope = slope + colour.image(intensity, rates.transfer)
        found.append(slope)
    return torch.stack(found)
