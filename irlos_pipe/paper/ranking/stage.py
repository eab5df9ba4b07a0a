"""Stage `ranking`: all calibration methods with the same modes and frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.results import Interval
from irlos_pipe.paper.common.variants import METHOD_NAMES
from irlos_pipe.paper.ranking.checks import checks_of
from irlos_pipe.paper.ranking.experiment import RankingSample, highest_nolls, rank
from irlos_pipe.paper.ranking.results import RankingResults as Results
from irlos_pipe.paper.ranking.results import RankingRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 3
READS = ()
DEPENDS_ON = ("instrument", "seed")
Condition = tuple[float, float]  # seeing ["], tail [nm]


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(20, ge=1, le=1000, description="cubes at each seeing, without a tail")
    samples_of_tails: int = Field(6, ge=0, le=1000, description="cubes at each seeing with each tail")
    samples_of_parts: int = Field(6, ge=0, le=1000, description="of those without, tried with fewer frames")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), min_length=1, description="on SPARTA's scale")
    tails_nm: tuple[float, ...] = Field(
        (1.0, 3.0, 10.0), description="RMS of every mode from Noll 52 to 200 [nm]"
    )
    highest_nolls: tuple[int, ...] = Field(
        (30, 51, 66), min_length=1, description="last fitted Noll mode of every method, 30 at least"
    )
    frames: int = Field(300, ge=10, le=10000, description="frames of a cube")
    parts: tuple[int, ...] = Field((10, 30, 100, 200), description="numbers of frames that are tried")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate all cubes and calibrate each by every method."""
    samples = list(_samples(ctx))
    found = run_samples(rank, samples, ctx, "cubes")
    by_condition: dict[Condition, list[Arrays]] = {}
    for sample, one in zip(samples, found, strict=True):
        by_condition.setdefault(_condition(sample), []).append(one)
    rows = [
        _row(ctx.config, condition, method, of_it)
        for condition, of_it in by_condition.items()
        for method in METHOD_NAMES
    ]
    drawn_nm = [_drawn_nm(sample) for sample in samples if not sample.tail_nm]
    results = Results(
        frames=ctx.config.frames,
        introduced_nm=float(np.mean(drawn_nm)),
        introduced_scatter_nm=float(np.std(drawn_nm)),
        rows=rows,
    )
    return StageOutput(
        _arrays(samples, found), results, checks_of(results), summary=[_line(row) for row in rows]
    )


def _samples(ctx: StageContext[Config]) -> Iterator[RankingSample]:
    config = ctx.config
    for seeing in config.seeings_arcsec:
        for index in range(config.samples):
            parts = config.parts if index < config.samples_of_parts else ()
            yield _sample(ctx, seeing, 0.0, index, parts)
        for tail_nm in config.tails_nm:
            for index in range(config.samples_of_tails):
                yield _sample(ctx, seeing, tail_nm, index, ())


def _sample(
    ctx: StageContext[Config], seeing_arcsec: float, tail_nm: float, index: int, parts: tuple[int, ...]
) -> RankingSample:
    """Return a cube; the n-th of every condition has the same NCPAs, but for its tail."""
    config = ctx.config
    cube = CubeSample(
        f"{seeing_arcsec:g} arcsec, tail {tail_nm:g} nm, cube {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        seeing_arcsec,
        config.frames,
        config.mag_j,
    )
    return RankingSample(cube, tail_nm, config.highest_nolls, parts)


def _condition(sample: RankingSample) -> Condition:
    return sample.cube.seeing_arcsec, sample.tail_nm


def _drawn_nm(sample: RankingSample) -> float:
    return float(np.linalg.norm(list(sample.scene().ncpa_nm.values())))


def _row(config: Config, condition: Condition, method: str, found: Sequence[Arrays]) -> RankingRow:
    seeing, tail_nm = condition
    modes = {str(last): f"{method}/{last}" for last in highest_nolls(method, config.highest_nolls)}
    first = {str(count): f"{method}/first_{count}" for count in config.parts}
    return RankingRow(
        seeing_arcsec=seeing,
        tail_nm=tail_nm,
        cubes=len(found),
        method=method,
        label=METHOD_NAMES[method],
        modes=_medians(modes, found),
        first=_medians(first, found),
    )


def _medians(keys: Mapping[str, str], found: Sequence[Arrays]) -> dict[str, Interval]:
    """Return the median over the cubes that have a number, by the name it goes by."""
    values = {name: [float(one[key]) for one in found if key in one] for name, key in keys.items()}
    return {name: Interval.of_median(of_it) for name, of_it in values.items() if of_it}


def _arrays(samples: Sequence[RankingSample], found: Sequence[Arrays]) -> dict[str, Quantity]:
    """One row per cube; NaN where something was not tried."""
    keys = sorted({key for one in found for key in one})
    arrays = {
        key: Quantity(np.array([float(one.get(key, np.nan)) for one in found]), "nm", "per cube")
        for key in keys
    }
    seeing, tail_nm = np.array([_condition(sample) for sample in samples]).T
    return arrays | {
        "seeing_arcsec": Quantity(seeing, "arcsec", "per cube"),
        "tail_nm": Quantity(tail_nm, "nm", "per cube"),
    }


def _line(row: RankingRow) -> str:
    numbers = ", ".join(f"{last} {one.value:.1f}" for last, one in row.modes.items())
    return f'{row.seeing_arcsec:g}", tail {row.tail_nm:g} nm, {row.label}: {numbers} nm'
