"""Noise that the pixels of a row or column share: pick-up in the read-out chain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Axis = Literal["rows", "columns"]


@dataclass(frozen=True)
class Pattern:
    """Stripes that differ from read to read.

    Attributes
    ----------
    e_rms : float
        Of one read [e- RMS].
    axis : {"rows", "columns"}
        Which pixels are alike: those of a row, or those of a column.
    period_px : float or None
        Of a tone across the stripes, whose phase is random in every read; None is 1/f noise, of which
        neighbouring stripes share most.
    """

    e_rms: float
    axis: Axis = "rows"
    period_px: float | None = None

    def drawn_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Return stripes of reads (..., rows, columns) that broadcast to `shape`, drawn from `rng` [e-]."""
        *reads, rows, columns = shape
        size = rows if self.axis == "rows" else columns
        stripes = self._tone(tuple(reads), size, rng) if self.period_px else _pink((*reads, size), rng)
        return self.e_rms * (stripes[..., :, None] if self.axis == "rows" else stripes[..., None, :])

    def _tone(self, reads: tuple[int, ...], size: int, rng: np.random.Generator) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi, (*reads, 1))
        return np.sqrt(2) * np.cos(2 * np.pi * np.arange(size) / (self.period_px or 1.0) + phase)


def _pink(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Series of unit variance with a power spectrum 1/f and no mean, along the last axis."""
    size = shape[-1]
    frequency = np.fft.rfftfreq(2 * size)[1:]  # twice as long: a window sees a part of the series
    modes = rng.standard_normal((*shape[:-1], len(frequency), 2)) @ np.array([1, 1j])
    spectrum = np.concatenate([np.zeros((*shape[:-1], 1)), modes / np.sqrt(frequency)], axis=-1)
    # each kept mode stands for its mirror image too; the last one, at Nyquist's frequency, for itself
    expected = 4 * np.sum(1 / frequency[:-1]) + 1 / frequency[-1]
    return np.fft.irfft(spectrum, n=2 * size, norm="forward")[..., :size] / np.sqrt(expected)
