"""Stage `first_tests`: the paper's first test on sky, simulated, and what its lessons are worth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.ramps import STARTS
from irlos_pipe.paper.common.seeing import on_spartas_scale
from irlos_pipe.paper.first_tests.checks import checks_of
from irlos_pipe.paper.first_tests.experiment import (
    STARTED,
    TARGETS,
    VARIANT_KEYS,
    Target,
    TargetSample,
    estimate,
    stage_error,
    target_errors,
    variants_of,
)
from irlos_pipe.paper.first_tests.results import FirstTestsResults as Results
from irlos_pipe.paper.first_tests.results import StartRow, TargetRow, VariantRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 5
READS = ()
DEPENDS_ON = ("instrument", "seed")
NUMBERS = ("slope", "rms_nm", "line_rms_nm", "converged")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs per target; the first is drawn")
    offsets: tuple[int, int] = Field((10, 8), description="positions of the ramps of the two targets")
    frames_per_offset: tuple[int, int] = Field((10, 20), description="of the first ramp of each target")
    frames_of_others: int = Field(2, ge=1, le=1000, description="frames per offset of the other ramps")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    ncpa_nm: float = Field(170.0, ge=0, le=1000, description="NCPAs over 50 modes: strong ones [nm RMS]")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate and estimate both targets with every set of NCPAs."""
    count = ctx.config.samples
    samples = [_sample(ctx, place, index) for place in range(len(TARGETS)) for index in range(count)]
    found = run_samples(estimate, samples, ctx, "ramps")
    by_target = {key: found[i * count : (i + 1) * count] for i, key in enumerate(TARGETS)}
    rows = [_target(ctx, key, of_it) for key, of_it in by_target.items()]
    arrays = {
        f"{key}/{name}": quantity
        for key, of_it in by_target.items()
        for name, quantity in _arrays(of_it[0]).items()
    }
    results = Results(targets=rows)
    return StageOutput(arrays, results, checks_of(results), summary=[_line(row) for row in rows])


def _sample(ctx: StageContext[Config], place: int, index: int) -> TargetSample:
    """The first ramp of a target has the paper's number of frames; the others give the scatter over NCPAs."""
    config = ctx.config
    key = list(TARGETS)[place]
    return TargetSample(
        f"{TARGETS[key].label}, ramp {index}",
        (ctx.seed, place, index),
        ctx.instrument.facility,
        key,
        _seeing_arcsec(ctx, TARGETS[key]),
        config.offsets[place],
        config.frames_of_others if index else config.frames_per_offset[place],
        config.cube_frames,
        config.ncpa_nm,
    )


def _seeing_arcsec(ctx: StageContext[Config], target: Target) -> float:
    """On SPARTA's scale."""
    return on_spartas_scale(ctx.instrument, target.seeing_arcsec)


# -- results ---------------------------------------------------------------------------------------


def _target(ctx: StageContext[Config], key: str, found: Sequence[Arrays]) -> TargetRow:
    target = TARGETS[key]
    return TargetRow(
        key=key,
        label=target.label,
        mag_j=target.mag_j,
        seeing_arcsec=target.seeing_arcsec,
        sparta_seeing_arcsec=_seeing_arcsec(ctx, target),
        samples=len(found),
        frames=[len(one["introduced_nm"]) for one in found],
        stage_error="saw_tooth" if target.hysteresis_nm else "second_run_bias",
        ways=[_variant(target, variant, found) for variant in VARIANT_KEYS],
        starts=[_start(variant, start, found) for variant in STARTED for start in STARTS],
    )


def _variant(target: Target, key: str, found: Sequence[Arrays]) -> VariantRow:
    """Numbers of the first ramp and of all of them."""
    variant = variants_of(target)[key]
    errors = [target_errors(one, key) for one in found]
    steps = [stage_error(one, key, target) for one in found]
    return VariantRow(
        key=key,
        label=variant.name,
        modes=list(variant.modes),
        **{name: [getattr(one, name) for one in errors] for name in NUMBERS},
        kernel_mas=[float(one[f"{key}/kernel_mas"]) for one in found],
        stage_true_nm=steps[0].true_nm,
        stage_found_nm=[step.found_nm for step in steps],
        stage_sigma_nm=[step.sigma_nm for step in steps],
    )


def _start(key: str, start: str, found: Sequence[Arrays]) -> StartRow:
    """Over the frames of all ramps."""
    wrong, iterations = (
        np.concatenate([one[f"{key}/{start}/{name}"] for one in found]) for name in ("wrong", "iterations")
    )
    return StartRow(
        way=key,
        start=start,
        frames=len(wrong),
        wrong=int(wrong.sum()),
        median_iterations=float(np.median(iterations)),
    )


def _arrays(first: Arrays) -> dict[str, Quantity]:
    """The first ramp of a target, frame by frame in the order of recording."""
    meanings = {
        "introduced_nm": "defocus commanded of the focus stage",
        "reached_nm": "defocus as the stage introduced it",
        "true_nm": "defocus of every frame's mean wavefront",
        "ncpa_nm": "defocus among the NCPAs",
    }
    arrays = {name: Quantity(first[name], "nm", text) for name, text in meanings.items()}
    for key in VARIANT_KEYS:
        total_nm = first[f"{key}/defocus_nm"] + first[f"{key}/given_nm"]
        arrays[f"{key}/total_nm"] = Quantity(total_nm, "nm", "estimated defocus, NCPAs given included")
    return arrays


def _line(row: TargetRow) -> str:
    hand, default = row.variant("hand_9"), row.variant("default_3")
    return (
        f"{row.label}: error {np.median(hand.rms_nm):.1f} nm RMS with kernel by hand, nine modes, "
        f"{np.median(default.rms_nm):.1f} nm with NCPAs, AO residual and three modes; "
        f"{row.stage_error.replace('_', ' ')} {default.stage_found_nm[0]:.1f} ± "
        f"{default.stage_sigma_nm[0]:.1f} nm (true {default.stage_true_nm:.0f} nm)"
    )
