"""Stage `seeing_scales`: SPARTA's seeing against that of a monitor, and the AO residual they stand for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.seeing import SPARTA, SeeingScale
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.seeing_scales.checks import checks_of
from irlos_pipe.paper.seeing_scales.experiment import Draws, Site, condition, draw_seeing
from irlos_pipe.paper.seeing_scales.results import Distributions, Relation
from irlos_pipe.paper.seeing_scales.results import SeeingScalesResults as Results
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 3
READS = ()
DEPENDS_ON = ("instrument", "seed")
RANKS = (16.0, 50.0, 84.0)  # percentiles of the distributions

Seeing = Annotated[float, Field(gt=0, le=10)]


class Config(StageConfig):
    """The relation and the statistics; of the paper's figure only the tendency is known."""

    monitor: str = Field("mass_dimm", description="seeing monitor, by its name in the instrument profile")
    ratio: float | None = Field(None, gt=0, le=10, description="SPARTA over monitor; null: the profile's")
    offset_arcsec: float | None = Field(None, ge=-1, le=1, description="added then; null: the profile's")
    median_arcsec: Seeing = Field(0.7, description="median of the monitor's seeing; assumed")
    scatter: float = Field(0.35, gt=0, le=2, description="standard deviation of its logarithm; assumed")
    disagreement: float = Field(0.15, ge=0, le=2, description="of the logarithm about the relation; assumed")
    draws: int = Field(20000, ge=100, le=10_000_000, description="simultaneous measurements drawn")
    simulated_arcsec: tuple[Seeing, ...] = Field((0.35, 1.0), description="of the simulations, by SPARTA")
    on_sky_arcsec: tuple[Seeing, ...] = Field((0.5, 1.2, 1.5), description="of the sky tests, by the monitor")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Draw simultaneous measurements, and translate the conditions of the paper."""
    config, law = ctx.config, ctx.instrument.facility.residual_law
    scale = _scale(ctx)
    site = Site(config.median_arcsec, config.scatter, config.disagreement)
    draws = draw_seeing(site, scale, config.draws, np.random.default_rng(ctx.seed))
    if np.any(draws.sparta_arcsec <= 0):
        raise ConfigurationError(
            f"seeing_scales.offset_arcsec = {scale.offset_arcsec:g}: makes good seeing "
            "negative on SPARTA's scale; raise it"
        )
    results = Results(
        monitor=config.monitor,
        relation=_relation(ctx, scale),
        residual_law=law,
        conditions=[
            condition(where, seeing, site, scale, draws, law) for where, seeing in _wanted(config, scale)
        ],
        distributions=_distributions(draws, law),
    )
    return StageOutput(_arrays(draws), results, checks_of(results), summary=_summary(results))


def _scale(ctx: StageContext[Config]) -> SeeingScale:
    """The profile's relation, changed as the recipe says."""
    config, known = ctx.config, ctx.instrument.seeing_scales
    monitors = sorted(known.keys() - {SPARTA})
    if config.monitor not in monitors:
        raise ConfigurationError(
            f"seeing_scales.monitor = '{config.monitor}': no such monitor in the "
            f"instrument profile; known: {', '.join(monitors) or 'none'}"
        )
    changes = {key: getattr(config, key) for key in ("ratio", "offset_arcsec")}
    return SeeingScale(
        **asdict(known[config.monitor]) | {key: value for key, value in changes.items() if value is not None}
    )


def _relation(ctx: StageContext[Config], scale: SeeingScale) -> Relation:
    """The relation, where its ratio comes from, and how well it is known."""
    if ctx.config.ratio is not None:
        return Relation(**asdict(scale), status="given", source="recipe")
    fact = ctx.instrument.facts[ctx.instrument.profile.seeing_scales[ctx.config.monitor].ratio][-1]
    return Relation(**asdict(scale), status=fact.status, source=fact.source)


def _wanted(config: Config, scale: SeeingScale) -> Iterator[tuple[str, float]]:
    """Where a condition is from, and its seeing by SPARTA."""
    for seeing in config.simulated_arcsec:
        yield "simulation", seeing
    for seeing in config.on_sky_arcsec:
        yield "sky", scale.to_sparta(seeing)


def _distributions(draws: Draws, law: ResidualLaw) -> Distributions:
    """Median and one-sigma range on both scales, and of the residual."""
    return Distributions(
        draws=len(draws.sparta_arcsec),
        monitor_arcsec=Percentiles.of(draws.monitor_arcsec, RANKS),
        sparta_arcsec=Percentiles.of(draws.sparta_arcsec, RANKS),
        wfe_nm=Percentiles.of(law.wfe_nm(draws.sparta_arcsec), RANKS),
        wfe_untranslated_nm=Percentiles.of(law.wfe_nm(draws.monitor_arcsec), RANKS),
    )


def _arrays(draws: Draws) -> dict[str, Quantity]:
    return {
        "draws/monitor_arcsec": Quantity(draws.monitor_arcsec, "arcsec", "seeing by the monitor"),
        "draws/sparta_arcsec": Quantity(draws.sparta_arcsec, "arcsec", "by SPARTA at the same time"),
    }


def _summary(results: Results) -> list[str]:
    relation, monitor = results.relation, results.monitor
    lines = [
        f"SPARTA = {relation.ratio:.2f} x {monitor} {relation.offset_arcsec:+.2f} arcsec ({relation.status})"
    ]
    return lines + [
        f"  {row.sparta_arcsec:.2f} by SPARTA, {row.monitor_arcsec:.2f} by {monitor}: "
        f"AO residual {row.wfe_nm:.0f} nm RMS, not {row.wfe_untranslated_nm:.0f}"
        for row in results.conditions
    ]
