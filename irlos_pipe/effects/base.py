"""What a physical effect declares, and how effects that act on the OTF are combined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from ..optics.propagate import FocalGrid
from ..optics.structure import ResidualBand


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, as a solver sees it.

    Attributes
    ----------
    name, unit : str
    start : float
        Where a fit begins.
    prior_mean, prior_sigma : float
        Gaussian prior; an infinite sigma means none.
    lower, upper : float
        Bounds that a fit respects.
    """

    name: str
    unit: str
    start: float
    prior_mean: float = 0.0
    prior_sigma: float = float("inf")
    lower: float = -float("inf")
    upper: float = float("inf")


class OtfGrid:
    """Baselines and wavelengths on which OTF factors are evaluated.

    Attributes
    ----------
    baseline_x_m, baseline_y_m : ndarray, (p//2 + 1,) and (p,)
    length2_m2 : tensor, (p, p//2 + 1)
        Squared length of the baselines.
    wavelengths_m : tensor, (wavelengths, 1, 1)
    """

    def __init__(self, grid: FocalGrid, wavelengths_m: Sequence[float]):
        self.baseline_x_m, self.baseline_y_m = grid.baseline_x_m, grid.baseline_y_m
        self.length2_m2 = torch.as_tensor(self.baseline_x_m[None, :] ** 2 + self.baseline_y_m[:, None] ** 2)
        self.wavelengths_m = torch.as_tensor(np.asarray(wavelengths_m, float))[:, None, None]


@dataclass(frozen=True)
class Conditions:
    """Circumstances of a recording that effects may start from: AO band and seeing."""

    band: ResidualBand
    seeing_arcsec: float


class OtfEffect(Protocol):
    """An effect that multiplies the OTF by ``exp(-exponent)``."""

    name: str
    parameters: tuple[Parameter, ...]

    @classmethod
    def under(cls, conditions: Conditions) -> OtfEffect:
        """The effect with starts and priors for these conditions."""

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """Minus the logarithm of the OTF factor, broadcastable to (wavelengths, p, p//2 + 1)."""

    def values_of(self, **public: float) -> list[float]:
        """Solver's parameters for given values of the public ones."""

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Parameters under the public names and units of the effect catalogue."""
