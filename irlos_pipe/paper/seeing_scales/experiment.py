"""The seeing scales of SPARTA and of a seeing monitor, and what their difference means for the AO residual.

The monitor's seeing is log-normal; SPARTA's follows from it by a linear relation and a log-normal
scatter, as the two look at different air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.seeing import SeeingScale
from irlos_pipe.paper.seeing_scales.results import ConditionRow


@dataclass(frozen=True)
class Site:
    """Statistics of the seeing.

    Attributes
    ----------
    median_arcsec : float
        Of the monitor's seeing.
    scatter : float
        Standard deviation of the logarithm of the monitor's seeing.
    disagreement : float
        Standard deviation of the logarithm of SPARTA's seeing about the relation.
    """

    median_arcsec: float
    scatter: float
    disagreement: float


@dataclass(frozen=True)
class Draws:
    """Simultaneous seeing of both, (draws,) [arcsec]."""

    monitor_arcsec: np.ndarray
    sparta_arcsec: np.ndarray


def draw_seeing(site: Site, scale: SeeingScale, draws: int, rng: np.random.Generator) -> Draws:
    """Draw simultaneous measurements of both.

    Parameters
    ----------
    site : Site
    scale : SeeingScale
        From the monitor's seeing to SPARTA's.
    draws : int
    rng : Generator
    """
    monitor = site.median_arcsec * np.exp(site.scatter * rng.standard_normal(draws))
    disagreement = np.exp(site.disagreement * rng.standard_normal(draws))
    return Draws(monitor, scale.to_sparta(monitor) * disagreement)


def log_normal_density(value: np.ndarray, median: float, scatter: float) -> np.ndarray:
    """Return the probability density of a log-normal variable, per unit of `value`.

    `median` is that of the variable, `scatter` the standard deviation of its logarithm.
    """
    deviation = np.log(value / median) / scatter
    return np.exp(-(deviation**2) / 2) / (value * scatter * np.sqrt(2 * np.pi))


def condition(
    where: str, sparta_arcsec: float, site: Site, scale: SeeingScale, draws: Draws, law: ResidualLaw
) -> ConditionRow:
    """Return what a seeing by SPARTA is by the monitor, how rare it is, and which residual it means.

    Parameters
    ----------
    where : str
        ``simulation`` or ``sky``.
    sparta_arcsec : float
    site : Site
    scale : SeeingScale
        From the monitor's seeing to SPARTA's.
    draws : Draws
        Simultaneous measurements, from which the rarity follows.
    law : ResidualLaw
        AO residual against SPARTA's seeing.
    """
    monitor = scale.from_sparta(sparta_arcsec)
    return ConditionRow(
        where=where,
        sparta_arcsec=sparta_arcsec,
        monitor_arcsec=monitor,
        better=float(np.mean(draws.sparta_arcsec < sparta_arcsec)),
        wfe_nm=law.wfe_nm(sparta_arcsec),
        wfe_sigma_nm=law.nm_per_arcsec * sparta_arcsec * site.disagreement,
        wfe_untranslated_nm=law.wfe_nm(monitor),
    )
