"""One wavelength of the light path: phase in the pupil, OTF factor, pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

NM = 1e-9


class Colour(NamedTuple):
    """What light of one wavelength meets.

    Attributes
    ----------
    wavelength_m, weight : float or scalar tensor
    pupil : tensor, (n, n), real or complex
    transfer : tensor, (p, p//2 + 1), or None
    to_rows, to_columns : tensor
        Pixel matrices, from the focal intensity without a `transfer`, from its real FFT with one.
    padded : int
        p, samples per axis of that FFT.
    """

    wavelength_m: float | torch.Tensor
    weight: float | torch.Tensor
    pupil: torch.Tensor
    transfer: torch.Tensor | None
    to_rows: torch.Tensor
    to_columns: torch.Tensor
    padded: int

    def _phase(self, opd_nm: torch.Tensor) -> torch.Tensor:
        return opd_nm * (2 * np.pi * NM / self.wavelength_m)

    def phasor(self, opd_nm: torch.Tensor) -> torch.Tensor:
        """``exp(2πi OPD/λ)``, shape of `opd_nm`."""
        phase = self._phase(opd_nm)
        return torch.polar(torch.ones_like(phase), phase)

    def field(self, opd_nm: torch.Tensor) -> torch.Tensor:
        """Complex field in the pupil, (frames, n, n)."""
        if self.pupil.is_complex():
            return self.pupil * self.phasor(opd_nm)
        return torch.polar(self.pupil.expand_as(opd_nm), self._phase(opd_nm))

    def image(self, intensity: torch.Tensor, transfer: torch.Tensor | None = None) -> torch.Tensor:
        """Pixel flux from focal intensity ``(..., m, m)``; `transfer` stands in for the own factor."""
        if self.transfer is None:
            return self.to_rows @ intensity @ self.to_columns.mT
        factor = self.transfer if transfer is None else transfer
        partial = self.to_rows @ (torch.fft.rfft2(intensity, s=(self.padded,) * 2) * factor)
        return partial.real @ self.to_columns.real.mT - partial.imag @ self.to_columns.imag.mT
