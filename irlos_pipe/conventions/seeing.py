"""Seeing on the scales of different monitors.

Instruments that watch different air through different apertures disagree on the seeing. The law of
the AO residual is stated on the scale of SPARTA, which estimates the seeing from the wavefront
sensors; MASS-DIMM, on its own tower, is more pessimistic.
"""

from __future__ import annotations

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

    def from_sparta(self, seeing_arcsec: Seeing) -> Seeing:
        """Return the seeing on the monitor's scale [arcsec]."""
        return (seeing_arcsec - self.offset_arcsec) / self.ratio
