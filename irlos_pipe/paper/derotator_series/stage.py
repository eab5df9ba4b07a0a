"""Stage `derotator_series`: the paper's derotator test on simulated cubes, with known truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict

import numpy as np
from pydantic import Field

from irlos_pipe.estimate.derotation import Series, try_both_senses, usable_modes
from irlos_pipe.files.json import jsonable
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.derotator_series.experiment import (
    AngleSample,
    Truth,
    draw_truth,
    estimate,
    rms_beyond_tilt_nm,
    split_errors,
)
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.derotator.output import SplitOutput, map_of

NAME = "derotator_series"
VERSION = 2
READS = ()
DEPENDS_ON = frozenset({"instrument", "seed"})
DEFAULT, PUBLISHED = "long_exposure", "dip_global"


class Config(StageConfig):
    """Sizes of the experiment."""

    angles_deg: tuple[float, ...] = Field(
        (0, 23, 46, 69, 92, 115, 138, 161, 180), min_length=2, description="derotator angles"
    )
    frames: int = Field(600, ge=10, le=10000, description="frames of a cube")
    published_frames: int = Field(
        100, ge=2, le=10000, description="the first frames, for the published method, which fits one by one"
    )
    seeing_arcsec: float = Field(1.2, gt=0, le=5)
    mag_j: float = Field(8.0, ge=0, le=20)
    rotating_nm: float = Field(50.0, ge=0, description="random NCPAs before the derotator, beside the bump")
    fixed_nm: float = Field(100.0, ge=0, description="random NCPAs behind it")


def run(ctx: StageContext) -> StageOutput:
    """Simulate and calibrate the cube of every angle, and split the estimates of every method."""
    truth = draw_truth(
        (ctx.seed,), ctx.instrument.facility.ncpa_law, ctx.config.rotating_nm, ctx.config.fixed_nm
    )
    numbers = run_samples(estimate, list(_samples(ctx, truth)), ctx, "angles")
    arrays = _truth_arrays(ctx, truth, numbers)
    methods, lines = {}, []
    for method in (DEFAULT, PUBLISHED):
        told = _split(ctx.config, numbers, method)
        own = told.arrays(ctx.instrument.pupil)
        arrays |= {f"{method}/{name}": quantity for name, quantity in own.items()}
        methods[method] = jsonable(told.results()) | _compared(told, truth, numbers, method)
        lines += _lines(method, methods[method])
    results = {
        "angles_deg": list(ctx.config.angles_deg),
        "frames": dict(_frames(ctx.config)),
        "truth": {
            "rotating_nm": rms_beyond_tilt_nm(truth.rotating_nm),
            "fixed_nm": rms_beyond_tilt_nm(truth.fixed_nm),
        },
        "methods": methods,
    }
    return StageOutput(arrays, results, summary=lines)


def _frames(config: Config) -> dict[str, int]:
    return {DEFAULT: config.frames, PUBLISHED: min(config.frames, config.published_frames)}


def _samples(ctx: StageContext, truth: Truth) -> Iterator[AngleSample]:
    for index, angle in enumerate(ctx.config.angles_deg):
        yield AngleSample(
            f"{angle:g} deg",
            (ctx.seed, 1, index),
            ctx.instrument.facility,
            truth,
            angle,
            _frames(ctx.config),
            ctx.config.seeing_arcsec,
            ctx.config.mag_j,
        )


def _split(config: Config, numbers: Sequence[Arrays], method: str) -> SplitOutput:
    series = Series(
        tuple(int(noll) for noll in numbers[0][f"{method}/noll"]),
        np.array(config.angles_deg, dtype=float),
        np.stack([one[f"{method}/zernike_nm"] for one in numbers]),
        np.stack([one[f"{method}/covariance_nm2"] for one in numbers]),
    )
    series = series.only(usable_modes(series.nolls))
    senses = try_both_senses(series)
    return SplitOutput(series, senses.best, senses)


def _compared(told: SplitOutput, truth: Truth, numbers: Sequence[Arrays], method: str) -> dict:
    """Errors of the split and of the single estimates."""
    return {
        "errors": asdict(split_errors(told.series, told.split, truth)),
        "delta_nm": [float(one[f"{method}/delta_nm"]) for one in numbers],
        "calibration_chi2_nu": [float(one[f"{method}/chi2_nu"]) for one in numbers],
    }


def _truth_arrays(ctx: StageContext, truth: Truth, numbers: Sequence[Arrays]) -> dict[str, Quantity]:
    pupil, arrays = ctx.instrument.pupil, {}
    for name, part_nm in (("rotating", truth.rotating_nm), ("fixed", truth.fixed_nm)):
        seen = {noll: value for noll, value in part_nm.items() if noll > 3}
        arrays[f"truth/maps/{name}_nm"] = map_of(
            pupil, list(seen), np.array(list(seen.values())), "simulated"
        )
    arrays["mean_image_e"] = Quantity(np.stack([one["mean_image_e"] for one in numbers]), "e-", "of a frame")
    return arrays


def _lines(method: str, found: dict) -> list[str]:
    errors, parts = found["errors"], found["parts"]
    return [
        f"{method:15s} {parts['rotating']['rms_nm']:.0f} nm turn, {parts['fixed']['rms_nm']:.0f} nm do not; "
        f"wrong by {errors['rotating_nm']:.1f} and {errors['fixed_nm']:.1f} nm in Noll 4–30",
        f"  Δ-WFE of single angles {np.median(found['delta_nm']):.1f} nm, median; sense {found['sense']} "
        f"(Δχ² {found['delta_chi2']:.0f}), χ²/ν {found['chi2_nu']:.2f}",
    ]
