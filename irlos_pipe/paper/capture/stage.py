"""Stage `capture`: from how far LIFT finds the defocus of a simulated frame, by where it starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.capture.checks import checks_of
from irlos_pipe.paper.capture.experiment import CaptureSample, capture
from irlos_pipe.paper.capture.outcome import WRONG_NM, Estimates, success_per_bin
from irlos_pipe.paper.capture.results import CaptureResults as Results
from irlos_pipe.paper.capture.results import StartRow
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.ramps import STARTS
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 7
READS = ()
DEPENDS_ON = ("instrument", "seed")
PAPER_NM = 410.0  # capture range that the paper states, started from zero
UNITS = {"defocus_nm": "nm", "start_nm": "nm", "sigma_nm": "nm", "converged": "", "chi2_nu": ""}


class Config(StageConfig):
    """Sizes and conditions of the experiment."""

    ramps: int = Field(30, ge=1, le=10000, description="sets of NCPAs")
    h_ramps: int = Field(10, ge=0, le=10000, description="further sets, known exactly, in H alone")
    frames: int = Field(50, ge=1, le=1000, description="frames with each set of NCPAs")
    reach_nm: float = Field(900.0, gt=0, le=1500, description="defocus is uniform within ± this [nm RMS]")
    required_nm: float = Field(600.0, gt=0, description="capture range that is asked for [nm RMS]")
    shift_px: float = Field(2.0, ge=0, le=10, description="star within ± this of the centre, each axis [px]")
    mag_j: float = Field(12.0, ge=0, le=25, description="J magnitude of the star")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    calibration_error_nm: float = Field(15.0, ge=0, description="error of the NCPAs given to LIFT [nm RMS]")
    bin_nm: float = Field(100.0, gt=0, description="width of the bins of the success curve [nm RMS]")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Draw all frames and estimate them from every start."""
    config = ctx.config
    edges_nm = np.linspace(-config.reach_nm, config.reach_nm, round(2 * config.reach_nm / config.bin_nm) + 1)
    samples = _samples(ctx, config.ramps, config.calibration_error_nm)
    h_samples = _samples(ctx, config.h_ramps, 0.0, h_alone=True)
    found = run_samples(capture, samples, ctx, "ramps")
    alone = run_samples(capture, h_samples, ctx, "ramps in H")
    rows, h_rows = (_rows(some, config, edges_nm) if some else [] for some in (found, alone))
    true_nm = _true_nm(found)
    results = Results(
        cases=len(true_nm),
        wrong_limit_nm=WRONG_NM,
        required_nm=config.required_nm,
        paper_nm=PAPER_NM,
        mag_j=config.mag_j,
        bin_edges_nm=edges_nm.tolist(),
        starts=rows,
        h_cases=config.h_ramps * config.frames,
        h_starts=h_rows,
    )
    return StageOutput(_arrays(true_nm, found), results, checks_of(results), summary=_summary(rows, h_rows))


def _samples(
    ctx: StageContext[Config], ramps: int, error_nm: float, *, h_alone: bool = False
) -> list[CaptureSample]:
    config = ctx.config
    return [
        CaptureSample(
            f"ramp {index}",
            (ctx.seed, index),
            ctx.instrument.facility,
            config.frames,
            config.reach_nm,
            config.shift_px,
            config.mag_j,
            config.seeing_arcsec,
            error_nm,
            h_alone,
        )
        for index in range(ramps)
    ]


def _true_nm(found: Sequence[Arrays]) -> np.ndarray:
    return np.concatenate([one["true_nm"] for one in found])


def _all(found: Sequence[Arrays], start: str, key: str) -> np.ndarray:
    return np.concatenate([one[f"{start}/{key}"] for one in found])


def _rows(found: Sequence[Arrays], config: Config, edges_nm: np.ndarray) -> list[StartRow]:
    """What came of every start."""
    true_nm = _true_nm(found)
    return [
        _row(
            name,
            Estimates(true_nm, *(_all(found, name, key) for key in ("defocus_nm", "converged"))),
            config,
            edges_nm,
        )
        for name in STARTS
    ]


def _row(name: str, estimates: Estimates, config: Config, edges_nm: np.ndarray) -> StartRow:
    required = estimates.within(config.required_nm)
    largest_right_nm, smallest_wrong_nm = estimates.gap_nm()
    captured, cases = success_per_bin(estimates, edges_nm)
    return StartRow(
        start=name,
        required=required.counts(),
        all=estimates.counts(),
        range_nm=estimates.range_nm(),
        rms_nm=required.rms_nm(),
        largest_right_nm=largest_right_nm,
        smallest_wrong_nm=smallest_wrong_nm,
        captured_per_bin=captured.tolist(),
        cases_per_bin=cases.tolist(),
    )


def _arrays(true_nm: np.ndarray, found: Sequence[Arrays]) -> dict[str, Quantity]:
    arrays = {"true_nm": Quantity(true_nm, "nm", "true defocus beyond the NCPAs, frame by frame")}
    for name in STARTS:
        for key, unit in UNITS.items():
            arrays[f"{name}/{key}"] = Quantity(_all(found, name, key), unit, f"{key} of LIFT, start: {name}")
    return arrays


def _summary(rows: Sequence[StartRow], h_rows: Sequence[StartRow]) -> list[str]:
    lines = ["start           captured / cases, wrong within the required range; range without a miss"]
    for band, some in (("", rows), (" (H)", h_rows)):
        for row in some:
            inside = row.required
            lines.append(
                f"  {row.start + band:13s} {inside.captured} / {inside.cases}, {inside.wrong}; "
                f"±{row.range_nm:.0f} nm, error {row.rms_nm:.1f} nm RMS"
            )
    return lines
