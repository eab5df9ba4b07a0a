"""What effects declare of themselves as data: planes, numbers with units and limits, circumstances."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from irlos_pipe.conventions.laws import NcpaLaw, ResidualLaw
from irlos_pipe.optics.structure import ResidualBand

INFINITE = float("inf")
Plane = Literal["pupil", "otf", "sampling", "time", "detector", "ramp"]


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
    null : float or None
        Value at which the effect is absent; None for a number that then means nothing, such as a position.
    plausible : (float, float)
        A value outside says that the effect stands in for something else.
    """

    name: str
    unit: str
    start: float
    prior_mean: float = 0.0
    prior_sigma: float = INFINITE
    lower: float = -INFINITE
    upper: float = INFINITE
    null: float | None = 0.0
    plausible: tuple[float, float] = (-INFINITE, INFINITE)


@dataclass(frozen=True)
class Public:
    """One number, list or table of an effect, as recipes and results have it.

    Attributes
    ----------
    name, unit : str
    kind : str
        A number; a table of Noll indices; four numbers, one per petal; a list of (row, column); a name.
    lower, upper : float
        Limits of every number in it.
    required : bool
        Whether an effect held at known values must be given it.
    """

    name: str
    unit: str
    kind: Literal["number", "zernike", "petals", "pixels", "nolls", "word"] = "number"
    lower: float = -INFINITE
    upper: float = INFINITE
    required: bool = True


@dataclass(frozen=True)
class Conditions:
    """Circumstances of a recording that effects may start from.

    Attributes
    ----------
    band : ResidualBand
        Spatial frequencies that the AO corrects.
    residual_law : ResidualLaw
        AO residual against seeing.
    seeing_arcsec : float
    diversity : dict of int to float
        Noll index to nm RMS, as introduced.
    highest_noll : int
        Last mode that is estimated as such.
    window : (int, int)
        Rows and columns [px].
    pixel_scale_mas : float
    spectrum : tuple of (wavelength_nm, weight)
    seeing_measured : bool
        Otherwise the seeing is a typical one.
    ncpa_law : NcpaLaw, optional
        Prior of the modes.
    """

    band: ResidualBand
    residual_law: ResidualLaw
    seeing_arcsec: float
    diversity: dict[int, float] = field(default_factory=dict)
    highest_noll: int = 30
    window: tuple[int, int] = (64, 64)
    pixel_scale_mas: float = 9.7
    spectrum: tuple[tuple[float, float], ...] = ((1600.0, 1.0),)
    seeing_measured: bool = True
    ncpa_law: NcpaLaw | None = None


def number(name: str, unit: str, lower: float = -INFINITE, upper: float = INFINITE, **more: Any) -> Public:
    """A public number."""
    return Public(name, unit, "number", lower, upper, **more)
