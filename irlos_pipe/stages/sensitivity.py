"""Stage `sensitivity`: defocus error against magnitude, with and without NCPAs, few and many modes."""

from __future__ import annotations

import numpy as np
from pydantic import Field, field_validator

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.lift import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion, Curve, scan
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)

NAME = "sensitivity"
VERSION = 7
NEEDS = ("ingest",)
READS = ("ingest", "prior", "calibrate")


class Config(StageConfig):
    """Settings of the sensitivity scan."""

    input: str = Field("ramp", description="recipe input that holds the ramp")
    max_defocus_nm: float = Field(
        170.0, gt=0, description="frames with a larger introduced defocus are left out"
    )
    mag_step: float = Field(1.0, gt=0, le=5, description="step of the magnitude grid")
    faintest_mag_j: float = Field(
        19.0, ge=0, le=30, description="end of the magnitude grid, which begins at the ramp's own"
    )
    realisations: int = Field(5, ge=1, le=1000, description="noise realisations per frame and magnitude")
    frames_per_offset: int = Field(2, ge=1, le=1000, description="frames of every offset that are used")
    modes: tuple[tuple[int, ...], ...] = Field(
        ((2, 3, 4), (2, 3, 4, 5, 7, 8, 9, 10, 11)), description="sets of Noll modes"
    )
    calibrated: tuple[bool, ...] = Field((True, False), description="with and without NCPAs")
    limit_nm: float = Field(30.0, gt=0, description="limiting magnitude: largest median error [nm RMS]")
    limit_failures: float = Field(0.1, ge=0, le=1, description="limiting magnitude: largest part of failures")

    @field_validator("modes")
    @classmethod
    def _focus_among_them(cls, modes: tuple) -> tuple:
        if any(4 not in one for one in modes):
            raise ValueError("every set of modes must hold 4 (defocus)")
        return modes


def run(ctx: StageContext) -> StageOutput:
    """Scan every combination of modes and calibration."""
    ramp = read_ramp(ctx, ctx.config.input)
    bright = ramp.acquisition.mag_j
    if bright is None:
        raise InputDataError(
            f"{ramp.recordings[0].name}: mag_j is missing; give it in acquisition.yaml, "
            "the magnitude scale hangs on it"
        )
    magnitudes = np.arange(bright, ctx.config.faintest_mag_j + 1e-9, ctx.config.mag_step)
    if len(magnitudes) == 0:
        raise InputDataError(
            f"sensitivity.faintest_mag_j {ctx.config.faintest_mag_j} is brighter than the ramp's "
            f"own m_J {bright}: frames can only be dimmed"
        )
    chosen = _choose(ramp, ctx.config)
    combinations = [(calibrated, nolls) for calibrated in ctx.config.calibrated for nolls in ctx.config.modes]
    with ctx.progress(total=len(combinations) * len(magnitudes), desc="sensitivity") as bar:
        curves = [
            _curve(ctx, ramp, chosen, calibrated, nolls, magnitudes, bar.update)
            for calibrated, nolls in combinations
        ]
    return _output(ctx.config, combinations, curves)


def _choose(ramp: Ramp, config: Config) -> np.ndarray:
    """Numbers of the frames used: the first few of every offset within reach."""
    introduced = ramp.data.introduced_nm
    chosen = [
        i
        for value in np.unique(introduced[np.abs(introduced) <= config.max_defocus_nm])
        for i in np.flatnonzero(introduced == value)[: config.frames_per_offset]
    ]
    if not chosen:
        raise InputDataError(
            f"no frame of the ramp has |introduced defocus| <= {config.max_defocus_nm} nm; "
            "raise sensitivity.max_defocus_nm"
        )
    return np.array(sorted(chosen))


def _curve(
    ctx: StageContext,
    ramp: Ramp,
    chosen: np.ndarray,
    calibrated: bool,
    nolls: tuple[int, ...],
    magnitudes: np.ndarray,
    report,
) -> Curve:
    """One curve; the model of each bright frame gives the noise-free signal and the start."""
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, nolls, ncpa_nm)
    start = ramp_start(ctx, model, ramp, ncpa_nm, "elongation")[chosen]
    data = RampData(
        ramp.data.images_e[chosen], ramp.data.pixel_mask, ramp.data.noise, ramp.data.introduced_nm[chosen]
    )
    effects = effects_for_lift(ctx, ramp.recordings[0], "calibrated", "calibrated", calibrated=calibrated)
    bright = fit_ramp(model, data, start, LiftOptions(), effects)
    criterion = Criterion(ctx.config.limit_nm, ctx.config.limit_failures)
    return scan(
        bright.model,
        data,
        bright.result.model_e,
        ramp.acquisition.mag_j,
        magnitudes,
        ctx.config.realisations,
        start,
        criterion,
        ctx.seed,
        near_nm=bright.result.zernike_nm,
        report=report,
    )


def _output(config: Config, combinations: list, curves: list[Curve]) -> StageOutput:
    rows, arrays = [], {}
    for number, ((calibrated, nolls), curve) in enumerate(zip(combinations, curves, strict=True)):
        row = {"calibrated": calibrated, "modes": list(nolls)}
        for key in ("mag_j", "median_abs_error_nm", "p16_nm", "p84_nm", "crb_nm", "failures"):
            values = getattr(curve, key)
            row[key] = values.tolist()
            arrays[f"curves/{number}/{key}"] = Quantity(
                values,
                "mag" if key == "mag_j" else "nm" if "nm" in key else "",
                f"NCPAs {'added' if calibrated else 'left out'}, {len(nolls)} modes",
            )
        rows.append(row | {"trials": curve.trials, "limit_mag": curve.limit_mag})
    results = {
        "curves": rows,
        "criterion": {"median_abs_error_nm": config.limit_nm, "failures": config.limit_failures},
        "crb_note": f"1 sigma; the median |error| of an efficient estimate is {MEDIAN_OF_NORMAL} of it",
    }
    return StageOutput(arrays, results, summary=_lines(config, rows))


def _lines(config: Config, rows: list[dict]) -> list[str]:
    lines = [
        f"Limit           median |error| ≤ {config.limit_nm:.0f} nm, failures ≤ {config.limit_failures:.0%}:"
    ]
    for row in rows:
        ncpas = "with" if row["calibrated"] else "without"
        lines.append(f"  {ncpas} NCPAs, {len(row['modes'])} modes: {_limit_text(row)}")
    return lines


def _limit_text(row: dict) -> str:
    """Limiting magnitude in words; at least that where the grid ends before the criterion is missed."""
    limit, grid_end = row["limit_mag"], row["mag_j"][-1]
    if not np.isfinite(limit):
        return "not reached at any magnitude"
    return f"m_J {'≥ ' if limit >= grid_end else ''}{limit:.1f}"
