"""One wavelength of the light path: phase in the pupil, OTF factor, pixels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch

from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.fourier_matrices import half_plane_counts
from irlos_pipe.optics.strained import Strained


class ByMode(NamedTuple):
    """A mode of `Optics.by_mode` at one wavelength.

    Attributes
    ----------
    map : tensor, (n, n)
        In mirrored order, see `matrix_dft`: phase [rad/nm], or logarithm of the amplitude.
    of_amplitude : bool
    factor : tensor, (p, p//2 + 1)
        Of the OTF.
    """

    map: torch.Tensor
    of_amplitude: bool
    factor: torch.Tensor


class Colour(NamedTuple):
    """What light of one wavelength meets.

    Attributes
    ----------
    wavelength_m : float or scalar tensor
    pupil : tensor, (n, n), real or complex
        In mirrored order, see `matrix_dft`.
    transfer : tensor, (p, p//2 + 1), or None
    to_rows, to_columns : tensor
        Pixel matrices, from the focal intensity without a `transfer`, from its real FFT with one.
        The photon weight of the wavelength is in the first.
    padded, samples : int
        p, samples per axis of that FFT, and m of the focal grid.
    strained : Strained or None
        Of a strained image, instead of the pixel matrices.
    by_mode : tuple of ByMode
    """

    wavelength_m: float | torch.Tensor
    pupil: torch.Tensor
    transfer: torch.Tensor | None
    to_rows: torch.Tensor
    to_columns: torch.Tensor
    padded: int
    samples: int
    strained: Strained | None = None
    by_mode: tuple[ByMode, ...] = ()

    def field(self, opd_nm: torch.Tensor) -> torch.Tensor:
        """Return the field ``P exp(2πi OPD/λ)`` of `opd_nm`, (frames, 2, n, n): real and imaginary part."""
        return behind(self.pupil, self.phasor(opd_nm))

    def phasor(self, opd_nm: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return real and imaginary part of ``exp(2πi OPD/λ)``, (frames, n, n) each."""
        phase = opd_nm * (2 * np.pi * NM / self.wavelength_m)
        return phase.cos(), phase.sin()

    @property
    def single(self) -> Colour:
        """The same in single precision: enough for derivatives, at less than half of the cost."""
        factor = None if self.transfer is None else _single(self.transfer)
        matrix = torch.complex64 if self.to_rows.is_complex() else torch.float32
        return self._replace(
            transfer=factor,
            to_rows=self.to_rows.to(matrix),
            to_columns=self.to_columns.to(matrix),
            strained=self.strained and self.strained.single,
            by_mode=tuple(one._replace(factor=_single(one.factor)) for one in self.by_mode),
        )

    def image(self, intensity: torch.Tensor) -> torch.Tensor:
        """Return the weighted pixel flux of a focal `intensity`, (..., m, m), without what modes add."""
        if self.strained is None and self.transfer is None:
            return self.to_rows @ (intensity @ self.to_columns.mT)
        return self._seen(self.waves(intensity))

    def whole_image(self, intensity: torch.Tensor, changes: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the same of an `intensity` with what modes add.

        Parameters
        ----------
        intensity : tensor, (..., m, m)
        changes : sequence of tensor, (..., m, m)
            Derivatives of the intensity by the modes of `by_mode`.
        """
        if not changes:
            return self.image(intensity)
        star, *others = self._unfiltered(torch.stack([intensity, *changes]))
        waves = star if self.transfer is None else star * self.transfer
        for other, one in zip(others, self.by_mode, strict=True):
            waves = waves + other * one.factor
        return self._seen(waves)

    def images_through(
        self, intensities: Sequence[torch.Tensor], transfers: Sequence[Sequence[torch.Tensor | None]]
    ) -> list[torch.Tensor]:
        """Return sums of the images of some intensities.

        Parameters
        ----------
        intensities : sequence of tensor, (..., m, m)
        transfers : sequence of sequence of tensor or None
            Their factors of the OTF in every sum; None of a factor that is zero.
        """
        if not transfers:
            return []
        waves = [self._unfiltered(one) for one in intensities]
        shape = *intensities[0].shape[:-2], len(self.to_rows), len(self.to_columns)

        def image(factors: Sequence[torch.Tensor | None]) -> torch.Tensor:
            lit = [wave * one for wave, one in zip(waves, factors, strict=True) if one is not None]
            return self._seen(reduce(torch.add, lit)) if lit else intensities[0].new_zeros(()).expand(shape)

        return [image(factors) for factors in transfers]

    def waves(self, intensity: torch.Tensor) -> torch.Tensor:
        """Real FFT of a focal `intensity` times the OTF factor, (..., p, p//2 + 1)."""
        waves = self._unfiltered(intensity)
        return waves if self.transfer is None else waves * self.transfer

    def _unfiltered(self, intensity: torch.Tensor) -> torch.Tensor:
        return torch.fft.rfft2(intensity, s=(self.padded,) * 2)

    def _seen(self, waves: torch.Tensor) -> torch.Tensor:
        """Weighted pixel flux of the `waves` of a focal intensity."""
        if self.strained is not None:
            return self.strained.image(waves)
        partial = self.to_rows @ waves
        return partial.real @ self.to_columns.real.mT - partial.imag @ self.to_columns.imag.mT

    def adjoint(self, factors: torch.Tensor) -> torch.Tensor:
        """Return the transpose of `image`: from pixels (..., rows, columns) to focal samples (..., m, m)."""
        if self.strained is None and self.transfer is None:
            return self.to_rows.mT @ (factors @ self.to_columns)
        if self.strained is not None:
            waves = self.strained.adjoint(factors)
        else:
            waves = self.to_rows.mH @ (factors.to(self.to_rows.dtype) @ self.to_columns.conj())
        counts = torch.as_tensor(half_plane_counts(waves.shape[-1], self.padded)).to(waves)
        waves = waves / counts  # the real FFT counts them itself
        if self.transfer is not None:
            waves = waves * self.transfer.conj()
        spread = torch.fft.irfft2(waves, s=(self.padded,) * 2, norm="forward")
        return spread[..., : self.samples, : self.samples]


def _single(factor: torch.Tensor) -> torch.Tensor:
    """An OTF factor in single precision."""
    return factor.to(torch.complex64 if factor.is_complex() else torch.float32)


def behind(pupil: torch.Tensor, phasor: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Field of a `phasor` behind a real or complex `pupil` (..., n, n), (..., frames, 2, n, n)."""
    cosine, sine = phasor
    if not pupil.is_complex():
        return torch.stack([pupil * cosine, pupil * sine], dim=-3)
    real, imag = pupil.real, pupil.imag
    return torch.stack([real * cosine - imag * sine, real * sine + imag * cosine], dim=-3)
