"""`tip_tilt_jitter`: isotropic Gaussian image motion within an exposure."""

from __future__ import annotations

import numpy as np
import torch

from ..optics.propagate import MAS
from .base import Conditions, OtfGrid, Parameter


class TipTiltJitter:
    """Gaussian blur of the image; the parameter is the variance, because ∂μ/∂σ vanishes at σ = 0.

    A Gaussian object of the same size (the `σ_obj` of LIFT) has the same OTF.
    """

    name = "tip_tilt_jitter"

    def __init__(self, start_mas: float = 7.0):
        self.parameters = (Parameter("variance_mas2", "mas²", start_mas**2, lower=0.0, upper=3600.0),)

    @classmethod
    def under(cls, conditions: Conditions) -> TipTiltJitter:
        """See `OtfEffect.under`; nothing here depends on the conditions."""
        return cls()

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """``2π² σ² |b|² / λ²``."""
        return 2 * np.pi**2 * values[0] * MAS**2 * grid.length2_m2 / grid.wavelengths_m**2

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """RMS per axis [mas]."""
        return {"sigma_mas": float(np.sqrt(max(values[0], 0.0)))}

    def values_of(self, sigma_mas: float) -> list[float]:
        """Solver's parameters for a known size [mas RMS per axis]."""
        return [sigma_mas**2]
