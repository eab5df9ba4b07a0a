"""Stage `derotator`: the part of the NCPAs that turns with the derotator, and the part that does not."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.estimate.derotator import Series, split_series, try_both_senses, usable_modes
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.per_recording import CubeEstimate, cube_estimates
from irlos_pipe.stages.calibrate.results import AngleRow
from irlos_pipe.stages.derotator.config import Config
from irlos_pipe.stages.derotator.output import SplitOutput, rms_nm, series_arrays
from irlos_pipe.stages.derotator.results import DerotatorResults


def run(ctx: StageContext[Config]) -> StageOutput:
    """Split the estimates of all cubes; report that this cannot be done with a single angle."""
    cubes = cube_estimates(ctx.products["calibrate"])
    if not cubes:
        raise ConfigurationError("derotator needs the cubes one by one: set calibrate.each to true")
    series = _series(cubes, ctx.config)
    rows = [AngleRow(name=cube.name, derotator_angle_deg=cube.derotator_angle_deg) for cube in cubes]
    one_angle = len(np.unique(series.angles_deg % 360)) == 1
    return _one_angle(ctx, rows, series) if one_angle else _split(ctx, rows, series)


def _series(cubes: list[CubeEstimate], config: Config) -> Series:
    series = Series(
        cubes[0].nolls,
        config.turn_per_degree * np.array([cube.derotator_angle_deg for cube in cubes]),
        np.stack([cube.zernike_nm for cube in cubes]),
        np.stack([cube.covariance_nm2 for cube in cubes]),
    )
    return series.only(usable_modes(series.nolls, config.highest_noll))


def _one_angle(ctx: StageContext[Config], cubes: list[AngleRow], series: Series) -> StageOutput:
    """Return what there is without a second angle: the estimates as measured."""
    angle = f"derotator angle {cubes[0].derotator_angle_deg:g}°"
    reason = f"all {len(cubes)} recordings are of {angle}" if len(cubes) > 1 else f"one recording, of {angle}"
    ctx.log.warning("%s: rotating and fixed parts cannot be separated", reason)
    results = DerotatorResults(
        cubes=cubes,
        modes=list(series.nolls),
        parts=None,
        reason=reason,
        measured_nm=[rms_nm(one) for one in series.zernike_nm],
    )
    lines = [
        f"Derotator       nothing split: {reason};",
        "  give recordings of two or more angles (derotator_angle_deg in acquisition.yaml)",
    ]
    return StageOutput(series_arrays(ctx.instrument.pupil, series), results, summary=lines)


def _split(ctx: StageContext[Config], cubes: list[AngleRow], series: Series) -> StageOutput:
    senses = try_both_senses(series)
    estimated = ctx.config.sense == "estimate"
    sense = 1 if ctx.config.sense == "anticlockwise" else -1
    found = SplitOutput(series, senses.best if estimated else split_series(series, sense), senses)
    checks = [found.check_explained(ctx.config.max_chi2_nu), *([found.check_sense()] if estimated else [])]
    results = DerotatorResults(cubes=cubes, **found.results())
    return StageOutput(found.arrays(ctx.instrument.pupil), results, checks, summary=found.summary())
