"""Stage `exposures`: calibration methods against the length of an exposure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.common.variants import METHOD_NAMES
from irlos_pipe.paper.exposures.checks import checks_of
from irlos_pipe.paper.exposures.experiment import ExposuresSample, compare
from irlos_pipe.paper.exposures.results import ExposuresResults as Results
from irlos_pipe.paper.exposures.results import MethodRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 2
READS = ()
DEPENDS_ON = ("instrument", "seed")
STEADY = 1.5  # the default may change by so much from one exposure to another: it fits the mean image


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="cubes at each seeing")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), min_length=1, description="on SPARTA's scale")
    shortest_s: float = Field(0.02, gt=0, le=10, description="shortest exposure [s]")
    sums: tuple[int, ...] = Field(
        (1, 5, 10, 25, 50), min_length=1, description="shortest exposures that are added to one"
    )
    frames: int = Field(500, ge=4, le=100000, description="shortest exposures of a cube")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")
    methods: tuple[str, ...] = Field(tuple(METHOD_NAMES), min_length=1, description="methods compared")

    @property
    def exposures_s(self) -> list[float]:
        """Return the exposures [s]."""
        return [self.shortest_s * count for count in self.sums]


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate all cubes and calibrate their sums by every method."""
    config = ctx.config
    samples = [_sample(ctx, s, i) for s in config.seeings_arcsec for i in range(config.samples)]
    found = run_samples(compare, samples, ctx, "cubes")
    rows = [
        _row(
            config, [one for one, of in zip(found, samples, strict=True) if of.cube.seeing_arcsec == s], s, m
        )
        for s in config.seeings_arcsec
        for m in config.methods
    ]
    results = Results(
        cubes=config.samples,
        exposures_s=config.exposures_s,
        total_s=config.shortest_s * config.frames,
        rows=rows,
    )
    return StageOutput(
        _arrays(samples, found), results, checks_of(results), summary=[_line(row) for row in rows]
    )


def _sample(ctx: StageContext[Config], seeing_arcsec: float, index: int) -> ExposuresSample:
    config = ctx.config
    cube = CubeSample(
        f"{seeing_arcsec:g} arcsec, cube {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        seeing_arcsec,
        config.frames,
        config.mag_j,
    )
    return ExposuresSample(cube, config.shortest_s, config.sums, config.methods)


def _row(config: Config, found: Sequence[Arrays], seeing_arcsec: float, method: str) -> MethodRow:
    by_exposure = [
        Percentiles.of([float(one[f"{count}/{method}/modes_nm"]) for one in found]) for count in config.sums
    ]
    best = int(np.argmin([one.median for one in by_exposure]))
    return MethodRow(
        seeing_arcsec=seeing_arcsec,
        method=method,
        label=METHOD_NAMES.get(method, method),
        modes_nm=by_exposure,
        best_s=config.exposures_s[best],
    )


def _arrays(samples: Sequence[ExposuresSample], found: Sequence[Arrays]) -> dict[str, Quantity]:
    arrays = {
        key: Quantity(np.array([float(one[key]) for one in found]), "nm", "per cube") for key in found[0]
    }
    seeing = np.array([one.cube.seeing_arcsec for one in samples])
    return arrays | {"seeing_arcsec": Quantity(seeing, "arcsec", "per cube")}


def _line(row: MethodRow) -> str:
    numbers = ", ".join(f"{one.median:.1f}" for one in row.modes_nm)
    return f'{row.seeing_arcsec:g}" {row.label}: {numbers} nm'
