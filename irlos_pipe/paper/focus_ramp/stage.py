"""Stage `focus_ramp`: simulated focus ramps estimated with and without calibrated NCPAs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.focus_ramp.experiment import WAYS, RampErrors, RampSample, estimate, ramp_errors
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = "focus_ramp"
VERSION = 5
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
    frames_per_offset: int = Field(2, ge=1, le=1000)
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    ways: tuple[Literal[tuple(WAYS)], ...] = Field(tuple(WAYS), min_length=1, description="of estimating it")
    seeing_arcsec: float = Field(0.35, gt=0, le=3)
    cube_mag_j: float = Field(7.0, ge=0, le=20)
    ramp_mag_j: float = Field(12.0, ge=0, le=20)


def run(ctx: StageContext) -> StageOutput:
    """Simulate and estimate all ramps, and sum up per way."""
    samples = [_sample(ctx, index) for index in range(ctx.config.samples)]
    numbers = run_samples(estimate, samples, ctx, "ramps")
    errors = {way: [ramp_errors(found, way) for found in numbers] for way in ctx.config.ways}
    ways = [_way(key, errors[key]) for key in ctx.config.ways]
    results = {"samples": len(numbers), "ways": ways}
    return StageOutput(_arrays(numbers[0], errors), results, summary=[_line(way) for way in ways])


def _sample(ctx: StageContext, index: int) -> RampSample:
    config: Config = ctx.config
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


def _way(key: str, errors: list[RampErrors]) -> dict:
    """One row of the results: median and spread over the samples."""
    way = WAYS[key]
    row = {"key": key, "label": way.name, "modes": list(way.modes), "ncpa": way.ncpa or None}
    values = {name: np.array([getattr(one, name) for one in errors]) for name in NUMBERS}
    for name, samples in values.items():
        p16, median, p84 = np.percentile(samples, [15.87, 50, 84.13])
        row[name] = {"median": float(median), "p16": float(p16), "p84": float(p84)}
    return row


def _arrays(first: Arrays, errors: dict[str, list[RampErrors]]) -> dict[str, Quantity]:
    """The first ramp frame by frame, and the numbers of every sample."""
    arrays = {
        "introduced_nm": Quantity(first["introduced_nm"], "nm", "first ramp: introduced defocus"),
        "true_nm": Quantity(first["true_nm"], "nm", "first ramp: Noll 2-11 of every frame's wavefront"),
    }
    for way, samples in errors.items():
        arrays[f"{way}/modes_nm"] = Quantity(
            first[f"{way}/modes_nm"], "nm", "first ramp: estimates (frame, mode), given NCPAs included"
        )
        rows = {name: np.array([asdict(one)[name] for one in samples]) for name in NUMBERS}
        for name, values in rows.items():
            arrays[f"{way}/{name}"] = Quantity(values, NUMBERS[name][0], f"{NUMBERS[name][1]}, per sample")
    return arrays


def _line(way: dict) -> str:
    slope, offset, rms = (way[name]["median"] for name in ("slope", "offset_nm", "rms_nm"))
    return (
        f"{way['label']}, {len(way['modes'])} modes: slope {slope:.3f}, offset {offset:+.1f} nm, "
        f"error {rms:.1f} nm RMS"
    )
