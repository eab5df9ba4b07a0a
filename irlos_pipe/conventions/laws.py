"""Laws of an instrument that its profile states by a few numbers: NCPAs by mode, AO residual by seeing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Seeing = TypeVar("Seeing", float, np.ndarray)
SPARTA = "sparta"


@dataclass(frozen=True)
class SeeingScale:
    """How the seeing of a monitor translates: ``SPARTA = ratio · monitor + offset``, the ratio positive."""

    ratio: float = 1.0
    offset_arcsec: float = 0.0

    def to_sparta(self, seeing_arcsec: Seeing) -> Seeing:
        """Return the seeing on SPARTA's scale [arcsec]."""
        return self.ratio * seeing_arcsec + self.offset_arcsec


@dataclass(frozen=True)
class NcpaLaw:
    """Standard deviation of the NCPAs [nm RMS], ``A exp(−B i) + C``, i = 0 for Noll 2."""

    amplitude_nm: float
    decay: float  # B, per mode
    plateau_nm: float

    def sigma_nm(self, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the standard deviation of modes `nolls` [nm RMS]."""
        index = np.asarray(nolls, float) - 2
        return self.amplitude_nm * np.exp(-self.decay * index) + self.plateau_nm


@dataclass(frozen=True)
class ResidualLaw:
    """RMS of the AO residual without piston, tip and tilt: proportional to the seeing, and a floor."""

    nm_per_arcsec: float
    floor_nm: float

    def wfe_nm(self, seeing_arcsec: Seeing) -> Seeing:
        """Return the residual [nm RMS] at a seeing at 500 nm, on the scale of the law."""
        return self.nm_per_arcsec * seeing_arcsec + self.floor_nm
