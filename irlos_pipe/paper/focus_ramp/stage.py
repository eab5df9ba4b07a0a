"""Stage `focus_ramp`: simulated focus ramps estimated with and without calibrated NCPAs."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from pydantic import Field, field_validator

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.focus_ramp.checks import checks_of
from irlos_pipe.paper.focus_ramp.experiment import RampErrors, RampSample, estimate, ramp_errors
from irlos_pipe.paper.focus_ramp.results import FocusRampResults as Results
from irlos_pipe.paper.focus_ramp.results import VariantRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 7
READS = ()
DEPENDS_ON = ("instrument", "seed")
NUMBERS = {  # unit and what it is
    "slope": ("", "slope of the estimated against the introduced defocus"),
    "offset_nm": ("nm", "offset of the straight line"),
    "rms_nm": ("nm", "RMS of estimated minus introduced defocus"),
    "line_rms_nm": ("nm", "RMS about the straight line"),
    "true_rms_nm": ("nm", "RMS against introduced defocus, NCPAs and AO residual of the frame"),
    "converged": ("", "part of the frames that converged"),
}


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(8, ge=1, le=1000, description="sets of NCPAs; the ramp of the first is drawn")
    reach_nm: float = Field(300.0, gt=0, le=600, description="the ramp goes from minus to plus this [nm RMS]")
    offsets: int = Field(13, ge=3, le=200, description="positions of the ramp")
    frames_per_offset: int = Field(2, ge=1, le=1000, description="frames at every position")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    ways: tuple[str, ...] = Field(tuple(LIFT_VARIANTS), min_length=1, description="variants of LIFT")
    seeing_arcsec: float = Field(0.35, gt=0, le=3, description="seeing on SPARTA's scale")
    cube_mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude in the calibration cube")
    ramp_mag_j: float = Field(12.0, ge=0, le=20, description="J magnitude in the ramp")

    @field_validator("ways")
    @classmethod
    def _known(cls, ways: tuple[str, ...]) -> tuple[str, ...]:
        for key in ways:
            if key not in LIFT_VARIANTS:
                raise ValueError(f"no variant '{key}'; known: {', '.join(LIFT_VARIANTS)}")
        return ways


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate and estimate all ramps, and summarise every variant."""
    samples = [_sample(ctx, index) for index in range(ctx.config.samples)]
    found = run_samples(estimate, samples, ctx, "ramps")
    errors = {key: [ramp_errors(one, key) for one in found] for key in ctx.config.ways}
    rows = [_row(key, of_it) for key, of_it in errors.items()]
    results = Results(samples=len(found), ways=rows)
    return StageOutput(
        _arrays(found[0], errors), results, checks_of(results), summary=[_line(row) for row in rows]
    )


def _sample(ctx: StageContext[Config], index: int) -> RampSample:
    config = ctx.config
    offsets = np.linspace(-config.reach_nm, config.reach_nm, config.offsets)
    return RampSample(
        f"ramp {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        tuple(offsets.tolist()),
        config.frames_per_offset,
        config.cube_frames,
        config.ways,
        config.seeing_arcsec,
        config.cube_mag_j,
        config.ramp_mag_j,
    )


def _row(key: str, errors: list[RampErrors]) -> VariantRow:
    """Median and spread over the samples."""
    variant = LIFT_VARIANTS[key]
    numbers = {name: Percentiles.of([getattr(one, name) for one in errors]) for name in NUMBERS}
    return VariantRow(
        key=key, label=variant.name, modes=list(variant.modes), ncpa=variant.ncpa or None, **numbers
    )


def _arrays(first: Arrays, errors: dict[str, list[RampErrors]]) -> dict[str, Quantity]:
    """The first ramp frame by frame, and the numbers of every sample."""
    arrays = {
        "introduced_nm": Quantity(first["introduced_nm"], "nm", "first ramp: introduced defocus"),
        "true_nm": Quantity(first["true_nm"], "nm", "first ramp: Noll 2-11 of every frame's wavefront"),
    }
    for key, samples in errors.items():
        arrays[f"{key}/modes_nm"] = Quantity(
            first[f"{key}/modes_nm"], "nm", "first ramp: estimates (frame, mode), given NCPAs included"
        )
        for name, (unit, text) in NUMBERS.items():
            values = np.array([asdict(one)[name] for one in samples])
            arrays[f"{key}/{name}"] = Quantity(values, unit, f"{text}, per sample")
    return arrays


def _line(row: VariantRow) -> str:
    return (
        f"{row.label}, {len(row.modes)} modes: slope {row.slope.median:.3f}, "
        f"offset {row.offset_nm.median:+.1f} nm, error {row.rms_nm.median:.1f} nm RMS"
    )
