"""Stage `ramp_conditions`: calibrated ramps with colours and filters that no calibration showed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field, field_validator

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.results import Interval
from irlos_pipe.paper.ramp_conditions.checks import checks_of
from irlos_pipe.paper.ramp_conditions.conditions import CONDITIONS, WAYS
from irlos_pipe.paper.ramp_conditions.experiment import ConditionsSample, estimate
from irlos_pipe.paper.ramp_conditions.outcome import RampErrors, errors_of
from irlos_pipe.paper.ramp_conditions.results import ModeRow, WayRow
from irlos_pipe.paper.ramp_conditions.results import RampConditionsResults as Results
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 3
READS = ()
DEPENDS_ON = ("instrument", "seed")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs")
    conditions: tuple[str, ...] = Field(
        tuple(CONDITIONS), min_length=1, description="what the light of the ramps has"
    )
    reach_nm: float = Field(300.0, gt=0, le=600, description="a ramp goes from minus to plus this [nm RMS]")
    offsets: int = Field(13, ge=3, le=200, description="positions of a ramp")
    frames_per_offset: int = Field(2, ge=1, le=1000, description="frames at every position")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    seeing_arcsec: float = Field(0.35, gt=0, le=3, description="seeing on SPARTA's scale")
    cube_mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude in the calibration cube")
    ramp_mag_j: float = Field(12.0, ge=0, le=20, description="J magnitude in the ramps in J and H")

    @field_validator("conditions")
    @classmethod
    def _known(cls, conditions: tuple[str, ...]) -> tuple[str, ...]:
        for key in conditions:
            if key not in CONDITIONS:
                raise ValueError(f"no condition '{key}'; known: {', '.join(CONDITIONS)}")
        return conditions


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate and estimate all ramps, and summarise every way under every condition."""
    samples = [_sample(ctx, index) for index in range(ctx.config.samples)]
    found = run_samples(estimate, samples, ctx, "sets of NCPAs")
    rows = [_row(found, *pair) for pair in _pairs(ctx.config.conditions)]
    results = Results(samples=len(found), rows=rows)
    return StageOutput(
        _arrays(found, ctx.config), results, checks_of(results), summary=[_line(row) for row in rows]
    )


def _sample(ctx: StageContext[Config], index: int) -> ConditionsSample:
    config = ctx.config
    offsets = np.linspace(-config.reach_nm, config.reach_nm, config.offsets)
    return ConditionsSample(
        f"NCPAs {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        tuple(offsets.tolist()),
        config.frames_per_offset,
        config.cube_frames,
        config.conditions,
        config.seeing_arcsec,
        config.cube_mag_j,
        config.ramp_mag_j,
    )


def _pairs(conditions: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Every condition with each of its ways."""
    for key in conditions:
        for way in CONDITIONS[key].ways:
            yield key, way


def _row(found: Sequence[Arrays], key: str, way: str) -> WayRow:
    """RMS over the samples."""
    condition, errors = CONDITIONS[key], [errors_of(one, key, way) for one in found]
    asked = condition.asked_nm if way == condition.ways[0] else None
    numbers = {
        name: Interval.of_rms([getattr(one, name) for one in errors])
        for name in ("rms_nm", "true_rms_nm", "bias_nm")
    }
    return WayRow(
        condition=key,
        condition_label=condition.label,
        way=way,
        label=WAYS[way].label,
        converged=min(one.converged for one in errors),
        asked_nm=float("nan") if asked is None else asked,
        modes=[_mode(errors, place, noll) for place, noll in enumerate(WAYS[way].modes)],
        **numbers,
    )


def _mode(errors: Sequence[RampErrors], place: int, noll: int) -> ModeRow:
    def rms(name: str) -> float:
        return float(np.sqrt(np.mean([getattr(one, name)[place] ** 2 for one in errors])))

    return ModeRow(
        noll=noll,
        error_nm=Interval.of_rms([one.mode_nm[place] for one in errors]),
        sigma_nm=rms("sigma_nm"),
        scatter_nm=rms("scatter_nm"),
        true_scatter_nm=rms("true_scatter_nm"),
        leak=rms("leak"),
    )


def _arrays(found: Sequence[Arrays], config: Config) -> dict[str, Quantity]:
    """The ramps of the first sample frame by frame, and the error of the defocus of every sample."""
    first = found[0]
    arrays = {"introduced_nm": Quantity(first["introduced_nm"], "nm", "introduced defocus")}
    for key in config.conditions:
        text = "first sample: Noll 2-11 of every frame's wavefront"
        arrays[f"{key}/true_nm"] = Quantity(first[f"{key}/true_nm"], "nm", text)
    for key, way in _pairs(config.conditions):
        name = f"{key}/{way}"
        arrays[f"{name}/modes_nm"] = Quantity(
            first[f"{name}/modes_nm"],
            "nm",
            "first sample: estimates (frame, mode), given NCPAs included",
            first[f"{name}/sigma_nm"],
        )
        errors_nm = np.array([errors_of(one, key, way).true_rms_nm for one in found])
        arrays[f"{name}/true_rms_nm"] = Quantity(errors_nm, "nm", "RMS error of the defocus, per sample")
    return arrays


def _line(row: WayRow) -> str:
    return (
        f"{row.condition_label}; {row.label}: {row.true_rms_nm.value:.1f} nm RMS "
        f"({row.true_rms_nm.low:.1f} to {row.true_rms_nm.high:.1f}), introduced {row.rms_nm.value:.1f} nm"
    )
