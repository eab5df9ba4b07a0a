"""Intensity in the focal plane, and its derivatives by phases and amplitudes in the pupil.

Fields and amplitudes are real arrays, (frames, 2, rows, columns), see `matrix_dft`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from irlos_pipe.optics.matrix_dft import MatrixDft
from irlos_pipe.optics.monochromatic import Colour


def intensity_of(amplitude: torch.Tensor) -> torch.Tensor:
    """Return ``|U|²``, (frames, m, m)."""
    return amplitude.square().sum(1)


def change_of(amplitude: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Return the change ``2 Re(U* ∂U)`` of the intensity, (..., frames, m, m).

    Parameters
    ----------
    amplitude : tensor, (frames, 2, m, m)
    by : tensor, (..., frames, 2, m, m)
        Its change.
    """
    return 2 * (amplitude * by).sum(-3)


def amplitudes_of(colour: Colour, dft: MatrixDft, field: torch.Tensor) -> list[torch.Tensor]:
    """Return the focal amplitude, (frames, 2, m, m), and its derivatives by modes of `Optics.by_mode`.

    Parameters
    ----------
    colour : Colour
        Has these modes.
    dft : MatrixDft
    field : tensor, (frames, 2, n, n)
    """
    return amplitudes(dft, [field, *turned_fields(colour, field)])


def amplitudes(dft: MatrixDft, fields: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return the focal amplitudes of some `fields`, each (frames, 2, n, n), transformed at once."""
    return list(dft.amplitude(torch.cat(list(fields))).split(len(fields[0]))) if fields else []


def turned_fields(colour: Colour, field: torch.Tensor) -> list[torch.Tensor]:
    """Return the derivatives of a `field` E by the modes of `Optics.by_mode` in a `colour`.

    They are ``i φ_k E`` for a mode of the phase, and ``φ_k E`` for one of the amplitude's logarithm.
    """
    return [one.map * (field if one.of_amplitude else times_i(field)) for one in colour.by_mode]


def times_i(field: torch.Tensor) -> torch.Tensor:
    """Return ``i E`` of a field E, (frames, 2, n, n)."""
    return torch.stack([-field[:, 1], field[:, 0]], dim=1)


def by_phase(field: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """Return ``Re(A* i E)``, (frames, n, n), of a `field` E and the adjoint A of what it makes."""
    return field[:, 0] * change[:, 1] - field[:, 1] * change[:, 0]


def beat_of(amplitude: torch.Tensor, products: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Return ``Im(U* F[T_a T_b E])``, (products, frames, m, m), of U and of `MatrixDft.products` of E."""
    (even, odd), real, imag = products, amplitude[:, 0], amplitude[:, 1]
    beat = torch.cat([even[:, :, 1], odd[:, :, 0]]) * real
    beat[: len(even)].addcmul_(even[:, :, 0], imag, value=-1)
    beat[len(even) :].addcmul_(odd[:, :, 1], imag)
    return beat
