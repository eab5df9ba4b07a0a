"""The seeing scales of SPARTA and of a seeing monitor, and what their difference means for the AO residual.

The monitor's seeing is log-normal; SPARTA's follows from it by a linear relation and a log-normal
scatter, as the two look at different air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.seeing import SeeingScale


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


@dataclass(frozen=True)
class Condition:
    """One seeing on both scales, and the residual WFE [nm RMS] that the law gives for each.

    Attributes
    ----------
    better : float
        Part of the time in which SPARTA's seeing is better than this.
    wfe_nm, wfe_sigma_nm : float
        From SPARTA's seeing, and its scatter where only the monitor's is known.
    wfe_untranslated_nm : float
        From the monitor's seeing taken for SPARTA's.
    """

    sparta_arcsec: float
    monitor_arcsec: float
    better: float
    wfe_nm: float
    wfe_sigma_nm: float
    wfe_untranslated_nm: float


def draw_seeing(site: Site, scale: SeeingScale, draws: int, rng: np.random.Generator) -> Draws:
    """Draw simultaneous measurements of both."""
    monitor = site.median_arcsec * np.exp(site.scatter * rng.standard_normal(draws))
    disagreement = np.exp(site.disagreement * rng.standard_normal(draws))
    return Draws(monitor, scale.to_sparta(monitor) * disagreement)


def log_normal_density(value: np.ndarray, median: float, scatter: float) -> np.ndarray:
    """Return the probability density of a log-normal variable, per unit of `value`."""
    deviation = np.log(value / median) / scatter
    return np.exp(-(deviation**2) / 2) / (value * scatter * np.sqrt(2 * np.pi))


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Return median and one-sigma range."""
    p16, median, p84 = map(float, np.percentile(values, (16, 50, 84)))
    return {"median": median, "p16": p16, "p84": p84}


def condition(
    sparta_arcsec: float, site: Site, scale: SeeingScale, draws: Draws, law: ResidualLaw
) -> Condition:
    """Return what a seeing by SPARTA is by the monitor, how rare it is, and which residual it means.

    Parameters
    ----------
    sparta_arcsec : float
    site : Site
    scale : SeeingScale
        From the monitor's seeing to SPARTA's.
    draws : Draws
        Simultaneous measurements, which say how rare a seeing is.
    law : ResidualLaw
        AO residual against SPARTA's seeing.
    """
    monitor = scale.from_sparta(sparta_arcsec)
    return Condition(
        sparta_arcsec,
        monitor,
        float(np.mean(draws.sparta_arcsec < sparta_arcsec)),
        law.wfe_nm(sparta_arcsec),
        law.nm_per_arcsec * sparta_arcsec * site.disagreement,
        law.wfe_nm(monitor),
    )
