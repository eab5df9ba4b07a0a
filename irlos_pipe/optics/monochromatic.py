"""One wavelength of the light path: phase in the pupil, OTF factor, intensity in the focal plane, pixels.

Fields and amplitudes are real arrays, (frames, 2, rows, columns), see `matrix_dft`. A wavelength acts on the
phase, on the size of a pixel in λ/D', and on whatever depends on it in the pupil and in the OTF; a photon
weight scales the image, and the pixel scale is the size of a pixel again. A strain gives pixels another
shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch

from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.fourier_matrices import (
    FocalGrid,
    MatrixDft,
    baseline_to_pixels,
    focal_samples_for,
    focal_to_pixels,
    half_plane_counts,
    quick_fft_length,
    require_resolved,
)
from irlos_pipe.optics.grids import PupilGrid, Sampling
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.strained import Strained, pixel_map_slope

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
Matrices = tuple[torch.Tensor, torch.Tensor]


class FocalPlane:
    """Where light of every wavelength falls on the pixels of one window.

    The `settings` give window, pixel scale and margins, `sampling` wavelengths and weights as built; the
    `polynomials`, (degree + 1, n), are those of `MatrixDft`. Matrices have the precision and device of
    `like`.
    """

    def __init__(
        self,
        settings: PsfSettings,
        sampling: Sampling,
        pupil: PupilGrid,
        polynomials: np.ndarray,
        like: torch.Tensor,
    ):
        self.window, self.sampling, self.like = settings.window, sampling, like
        wavelengths_m, window_px = sampling.wavelengths_m.numpy(), max(settings.window)
        require_resolved(
            window_px, settings.pixel_scale_mas, wavelengths_m.min(), pupil.u_m[1] - pupil.u_m[0]
        )

        def samples(margin_mas: float, wavelength_m: float) -> int:
            of = window_px, settings.pixel_scale_mas, margin_mas, wavelength_m
            return focal_samples_for(*of, pupil.width_m)

        # One per wavelength: long waves need fewer samples; the baselines are common.
        needed = [samples(settings.margin_mas, wavelength_m) for wavelength_m in wavelengths_m]
        period = samples(settings.halo_margin_mas, wavelengths_m.min())
        padded = quick_fft_length(max(*needed, period))
        self.grids = [FocalGrid(count, pupil.width_m, padded, pupil.longest_m) for count in needed]
        self.dfts = [MatrixDft(pupil.u_m, focal, polynomials, like) for focal in self.grids]

    @property
    def widest(self) -> FocalGrid:
        return max(self.grids, key=lambda grid: grid.samples)

    def to_pixels(
        self, index: int, sampling: Sampling | None, *, filtered: bool, slope: bool = False
    ) -> Matrices:
        """Return matrices to rows, weighted, and to columns, at the wavelength `index`.

        A `sampling` is given where effects change it. Matrices are applied to the real FFT of the focal
        intensity if `filtered`, otherwise to the intensity itself. With `slope` they are the derivatives by
        the logarithm of pixel scale over wavelength.
        """
        sampling, grid, (rows, columns) = sampling or self.sampling, self.grids[index], self.window
        sky = sampling.pixel_scale_mas, sampling.wavelengths_m[index], grid
        if filtered:
            along_y = baseline_to_pixels(grid.baseline_y_m, rows, *sky, half=False, slope=slope)
            along_x = baseline_to_pixels(grid.baseline_x_m, columns, *sky, half=True, slope=slope)
        else:
            made = {px: focal_to_pixels(px, *sky, slope=slope) for px in {rows, columns}}
            along_y, along_x = made[rows], made[columns]
        like = self.like.device, COMPLEX[self.like.dtype] if filtered else self.like.dtype
        return (sampling.weights[index] * along_y).to(*like), along_x.to(*like)

    def strained(self, index: int, sampling: Sampling) -> Strained:
        """Return the matrices to pixels of a strained image, at the wavelength `index`."""
        like = self.like.new_empty(0, dtype=COMPLEX[self.like.dtype])
        return Strained.of(self.window, sampling, index, self.grids[index], like)


class ByMode(NamedTuple):
    """A mode of `Optics.by_mode` at one wavelength."""

    # (n, n): in mirrored order, see `matrix_dft`: phase [rad/nm], or logarithm of the amplitude
    map: torch.Tensor
    of_amplitude: bool
    factor: torch.Tensor  # (p, p//2 + 1): of the OTF


class Colour(NamedTuple):
    """What light of one wavelength meets."""

    wavelength_m: float | torch.Tensor
    pupil: torch.Tensor  # (n, n), real or complex: in mirrored order, see `matrix_dft`
    transfer: torch.Tensor | None  # (p, p//2 + 1), or None
    # to_rows, to_columns: pixel matrices, from the focal intensity without a `transfer`, from its real FFT
    # with one. The photon weight of the wavelength is in the first.
    to_rows: torch.Tensor
    to_columns: torch.Tensor
    # padded, samples: p, samples per axis of that FFT, and m of the focal grid
    padded: int
    samples: int
    strained: Strained | None = None  # of a strained image, instead of the pixel matrices
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
        """Return the same of an `intensity` (..., m, m) with what modes add.

        The `changes` are its derivatives by the modes of `by_mode`, (..., m, m) each.
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
        """Return sums of the images of some `intensities`, (..., m, m) each.

        The `transfers` are their factors of the OTF in every sum; None of a factor that is zero.
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
        return torch.view_as_real(self.to_rows @ waves).flatten(-2) @ _parts(self.to_columns).mT

    def adjoint(self, factors: torch.Tensor) -> list[torch.Tensor]:
        """Return the transpose of `whole_image`, from pixels (..., rows, columns) to focal ones (..., m, m).

        That of the intensity comes first, then those of its changes by the modes of `by_mode`.
        """
        if self.strained is None and self.transfer is None and not self.by_mode:
            return [self.to_rows.mT @ (factors @ self.to_columns)]
        if self.strained is not None:
            waves = self.strained.adjoint(factors)
        else:
            matrix = _parts(self.to_columns)
            along_x = (factors.to(matrix) @ matrix).unflatten(-1, (-1, 2))
            waves = self.to_rows.mH @ torch.view_as_complex(along_x)
        counts = half_plane_counts(waves.shape[-1], self.padded)  # the real FFT counts them itself
        once = torch.as_tensor(1 / counts).to(waves.real)
        through = [once if self.transfer is None else self.transfer.conj() * once]
        through += [one.factor.conj() * once for one in self.by_mode]
        size = (self.padded,) * 2
        spread = (torch.fft.irfft2(waves * one, s=size, norm="forward") for one in through)
        return [one[..., : self.samples, : self.samples] for one in spread]


def _parts(matrix: torch.Tensor) -> torch.Tensor:
    """Real and minus imaginary parts of a complex `matrix` (m, n) by turns, (m, 2 n)."""
    return torch.view_as_real(matrix.conj().resolve_conj()).flatten(-2)


def _single(factor: torch.Tensor) -> torch.Tensor:
    return factor.to(torch.complex64 if factor.is_complex() else torch.float32)


def behind(pupil: torch.Tensor, phasor: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Field of a `phasor` behind a real or complex `pupil` (..., n, n), (..., frames, 2, n, n)."""
    cosine, sine = phasor
    if not pupil.is_complex():
        return torch.stack([pupil * cosine, pupil * sine], dim=-3)
    real, imag = pupil.real, pupil.imag
    return torch.stack([real * cosine - imag * sine, real * sine + imag * cosine], dim=-3)


def intensity_of(amplitude: torch.Tensor) -> torch.Tensor:
    """Return ``|U|²``, (frames, m, m)."""
    return amplitude.square().sum(1)


def change_of(amplitude: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Return the change ``2 Re(U* ∂U)`` of the intensity, (..., frames, m, m).

    The `amplitude` is (frames, 2, m, m); it changes `by` (..., frames, 2, m, m).
    """
    return 2 * (amplitude * by).sum(-3)


def amplitudes_of(colour: Colour, dft: MatrixDft, field: torch.Tensor) -> list[torch.Tensor]:
    """Return the focal amplitude, (frames, 2, m, m), and its derivatives by modes of `Optics.by_mode`.

    The `colour` has these modes; `dft` leads to the focal plane from the `field`, (frames, 2, n, n).
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


def by_phase(colour: Colour, field: torch.Tensor, changes: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return ``Re(A* i E)``, (frames, n, n), of a `field` E and the adjoint A of what it makes in a `colour`.

    The `changes`, whose first is overwritten, are the adjoints of what it and its `turned_fields` make.
    """
    whole, *others = changes
    for one, change in zip(colour.by_mode, others, strict=True):
        back, sign = (change, 1) if one.of_amplitude else (times_i(change), -1)
        whole.addcmul_(one.map, back, value=sign)
    return field[:, 0] * whole[:, 1] - field[:, 1] * whole[:, 0]


def beat_of(amplitude: torch.Tensor, products: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Return ``Im(U* F[T_a T_b E])``, (products, frames, m, m), of U and of `MatrixDft.products` of E."""
    (even, odd), real, imag = products, amplitude[:, 0], amplitude[:, 1]
    beat = torch.cat([even[:, :, 1], odd[:, :, 0]]) * real
    beat[: len(even)].addcmul_(even[:, :, 0], imag, value=-1)
    beat[len(even) :].addcmul_(odd[:, :, 1], imag)
    return beat


class Rates(NamedTuple):
    """How fast one parameter changes what light of one colour meets."""

    # weight, wavelength, scale: relative to the photon weight, the wavelength and the pixel scale
    weight: float
    wavelength: float
    scale: float
    strain: torch.Tensor  # (2,): of the image, see `Sampling`
    # pupil, transfer: as of `Colour`, or None
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


def resampled(
    colour: Colour,
    plane: FocalPlane,
    index: int,
    sampling: Sampling,
    opd_nm: torch.Tensor,
    every: Sequence[Rates],
) -> torch.Tensor:
    """Return derivatives of weighted images at one wavelength, (parameters, frames, rows, columns).

    Light of the `colour`, number `index` of a `sampling`, falls on a `plane` with the wavefronts `opd_nm`
    (frames, n, n) and changes at the rates `every`, one per parameter.
    """
    phasor, dft = colour.phasor(opd_nm), plane.dfts[index]
    field = behind(colour.pupil, phasor)
    amplitude = dft.amplitude(field)
    intensity = intensity_of(amplitude)
    image, larger = colour.image(intensity), [rates.scale - rates.wavelength for rates in every]
    if colour.strained or any(rates.strain.any() for rates in every):  # pixels become parallelograms
        strained, strain = plane.strained(index, sampling), sampling.strain.detach()
        changes = [
            factor * strained.pixels.map + pixel_map_slope(strain, rates.strain)
            for factor, rates in zip(larger, every, strict=True)
        ]
        slopes = strained.slopes(colour.waves(intensity), changes)
        # A pixel that is larger by a factor shows its square times the light.
        by_pixels = [2 * factor * image + slope for factor, slope in zip(larger, slopes, strict=True)]
    else:
        rows, columns = plane.to_pixels(index, sampling, filtered=colour.transfer is not None, slope=True)
        along = colour._replace(to_rows=rows), colour._replace(to_columns=columns)
        wider = along[0].image(intensity) + along[1].image(intensity)
        by_pixels = [factor * wider for factor in larger]
    turned = times_i(field)
    phase = (opd_nm * (2 * np.pi * NM / colour.wavelength_m))[:, None]
    found = []
    for rates, pixels in zip(every, by_pixels, strict=True):
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
