"""Stage `sensitivity`: defocus error against magnitude, with and without NCPAs, few and many modes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion, Curve, scan
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)
from irlos_pipe.stages.sensitivity.config import Config
from irlos_pipe.stages.sensitivity.effort import announce
from irlos_pipe.stages.sensitivity.noise import Noises, noises_of
from irlos_pipe.stages.sensitivity.results import CriterionRow, CurveRow, NoiseRow, SensitivityResults

# Arrays of a curve with their units.
UNITS = {
    "mag_j": "mag",
    "median_abs_error_nm": "nm",
    "p16_nm": "nm",
    "p84_nm": "nm",
    "crb_nm": "nm",
    "one_read_crb_nm": "nm",
    "failures": "",
}


def run(ctx: StageContext[Config]) -> StageOutput:
    """Scan every combination of modes and calibration."""
    ramp = read_ramp(ctx, ctx.config.input)
    bright = ramp.acquisition.mag_j
    if bright is None:
        raise InputDataError(
            f"{ramp.recordings[0].name}: mag_j is missing; give it in acquisition.yaml, "
            "the magnitudes of the dimmed frames are counted from it"
        )
    magnitudes = np.arange(bright, ctx.config.faintest_mag_j + 1e-9, ctx.config.mag_step)
    if len(magnitudes) == 0:
        raise InputDataError(
            f"sensitivity.faintest_mag_j {ctx.config.faintest_mag_j} is brighter than the ramp's "
            f"own m_J {bright}: frames can only be dimmed"
        )
    chosen = _choose(ramp, ctx.config)
    noises = noises_of(ramp, bright, ctx.instrument, ctx.config.noise)
    combinations = [(calibrated, nolls) for calibrated in ctx.config.calibrated for nolls in ctx.config.modes]
    window = ramp.recordings[0].window
    announce(len(chosen), window, ctx.config.realisations, len(magnitudes), len(combinations), ctx.log)
    with ctx.progress(total=len(combinations) * len(magnitudes), desc="sensitivity") as bar:
        curves = [
            _curve(ctx, ramp, chosen, calibrated, nolls, magnitudes, noises, bar.update)
            for calibrated, nolls in combinations
        ]
    return _output(ctx.config, combinations, curves, noises.row(ramp.acquisition.exposure_s))


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
    ctx: StageContext[Config],
    ramp: Ramp,
    chosen: np.ndarray,
    calibrated: bool,
    nolls: tuple[int, ...],
    magnitudes: np.ndarray,
    noises: Noises,
    report: Callable[[int], None],
) -> Curve:
    """One curve; the model of each bright frame gives the noise-free signal and the start."""
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, nolls, ncpa_nm)
    start = ramp_start(ctx, model, ramp, ncpa_nm, "elongation")[chosen]
    data = RampData(
        ramp.data.images_e[chosen], ramp.data.good, ramp.data.noise, ramp.data.introduced_nm[chosen]
    )
    effects = effects_for_lift(ctx, ramp.recordings[0], "calibrated", "calibrated", calibrated=calibrated)
    bright = fit_ramp(model, data, start, LiftOptions(), effects)
    criterion = Criterion(ctx.config.limit_nm, ctx.config.limit_failures)
    return scan(
        bright.model,
        data,
        bright.result.model_e,
        float(magnitudes[0]),
        magnitudes,
        ctx.config.realisations,
        start,
        criterion,
        ctx.seed,
        faint=noises.faint,
        one_read=noises.one_read,
        near_nm=bright.result.zernike_nm,
        report=report,
    )


def _output(
    config: Config,
    combinations: Sequence[tuple[bool, tuple[int, ...]]],
    curves: Sequence[Curve],
    noise: NoiseRow,
) -> StageOutput:
    rows: list[CurveRow] = []
    arrays: dict[str, Quantity] = {}
    for number, ((calibrated, nolls), curve) in enumerate(zip(combinations, curves, strict=True)):
        values = {key: getattr(curve, key) for key in UNITS}
        text = f"NCPAs {'added' if calibrated else 'left out'}, {len(nolls)} modes"
        arrays |= {f"curves/{number}/{key}": Quantity(values[key], UNITS[key], text) for key in UNITS}
        lists = {key: value.tolist() for key, value in values.items()}
        own = CurveRow(
            calibrated=calibrated,
            modes=list(nolls),
            trials=curve.trials,
            limit_mag=curve.limit_mag,
            one_read_bound_mag=curve.bound_mag(Criterion(config.limit_nm, config.limit_failures)),
            **lists,
        )
        rows.append(own)
    results = SensitivityResults(
        curves=rows,
        criterion=CriterionRow(median_abs_error_nm=config.limit_nm, failures=config.limit_failures),
        noise=noise,
        crb_note=f"1 sigma; the median |error| of an efficient estimate is {MEDIAN_OF_NORMAL} of it",
    )
    return StageOutput(arrays, results, summary=_lines(config, rows, noise))


def _lines(config: Config, rows: Sequence[CurveRow], noise: NoiseRow) -> list[str]:
    lines = [
        f"Noise           {noise_text(noise)}",
        f"Limit           median |error| ≤ {config.limit_nm:.0f} nm, failures ≤ {config.limit_failures:.0%}:",
    ]
    for row in rows:
        ncpas = "with" if row.calibrated else "without"
        lines.append(f"  {ncpas} NCPAs, {len(row.modes)} modes: {_limit_text(row)}")
    return lines


def noise_text(noise: NoiseRow) -> str:
    """Return the noise of the dimmed frames in words."""
    if noise.reads is None:
        return f"{noise.floor_e2:.3g} e⁻² per pixel, as recorded"
    ratio = noise.floor_e2 / noise.one_read_floor_e2
    sky = (noise.sky_e + noise.dark_e) * noise.excess_noise_factor
    return (
        f"{noise.reads} reads of {noise.read_noise_e:.2g} e⁻ in {noise.exposure_s:g} s, sky and dark "
        f"{sky:.2g} e⁻²: {noise.floor_e2:.3g} e⁻² per pixel, {ratio:.3g} times that of one read without sky"
    )


def _limit_text(row: CurveRow) -> str:
    """Limiting magnitude as text; with ≥ where the grid ends before the criterion is missed."""
    if not math.isfinite(row.limit_mag):
        return "not reached at any magnitude"
    return f"m_J {'≥ ' if row.at_the_end else ''}{row.limit_mag:.1f}"
