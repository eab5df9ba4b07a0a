"""Stage `slow_loop`: the slow focus loop closed on LIFT in simulation, against the drifting sodium layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import Field

from irlos_pipe.control.disturbance import SodiumLayer
from irlos_pipe.control.linear_theory import Integrator, best_gain
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.reads import NoiseOf, Read
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.slow_loop.checks import checks_of
from irlos_pipe.paper.slow_loop.experiment import (
    UNCALIBRATED,
    Conditions,
    LoopSample,
    at_best_gain,
    gain_scan,
    noise_law,
    run_loops,
)
from irlos_pipe.paper.slow_loop.loops import Loop
from irlos_pipe.paper.slow_loop.outcome import LoopOutcome, outcome_of
from irlos_pipe.paper.slow_loop.results import LoopRow
from irlos_pipe.paper.slow_loop.results import SlowLoopResults as Results
from irlos_pipe.paper.slow_loop.two_by_two import TWO_BY_TWO
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 8
READS = ()
DEPENDS_ON = ("instrument", "seed")


class Layer(StageConfig):
    """The sodium layer, see `SodiumLayer` for the sources of the defaults."""

    slope: float = Field(default=1.95, gt=1, lt=3, description="of the altitude's power spectrum, f^-slope")
    rms_change_1s_m: float = Field(
        default=23.0, gt=0, description="RMS change of the mean altitude within 1 s [m]"
    )
    range_m: float = Field(default=89.4e3, gt=1e4, description="from the telescope to the layer [m]")


class Config(StageConfig):
    """Sizes and conditions of the experiment."""

    skies: int = Field(4, ge=1, le=1000, description="sets of NCPAs, each with its sky and its calibration")
    drifts: int = Field(1, ge=1, le=1000, description="drifts of the sodium layer on each sky")
    frames: int = Field(120, ge=10, le=100000, description="frames of 1 s per drift")
    settle: int = Field(20, ge=0, description="frames left out of the statistics")
    magnitudes: tuple[float, ...] = Field((12, 16, 17, 18, 19, 20), min_length=1, description="J mag")
    configurations: tuple[str, ...] = Field(
        (UNCALIBRATED, PAPER_CHOICE, DEFAULT, *TWO_BY_TWO),
        description="calibration methods, `uncalibrated`; of the 2x2 mode `centroids_2x2`, `lift_2x2`",
    )
    scan_magnitudes: tuple[float, ...] = Field((12, 18), description="stars of the scan of gains")
    scan_gains: tuple[float, ...] = Field((0.05, 0.1, 0.2, 0.6, 0.8), description="gains of the scan")
    half_rate: bool = Field(True, description="also frames of 2 s, with the default calibration")
    delay: int = Field(1, ge=0, le=10, description="frames between exposure and correction")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    calibration_frames: int = Field(100, ge=10, le=10000, description="frames of the calibration cube")
    noise: NoiseOf = Field(
        "reads", description="of the loop's exposures: all reads with sky and dark, or one read"
    )
    layer: Layer = Layer()


def run(ctx: StageContext[Config]) -> StageOutput:
    """Run all loops on all skies and summarise them."""
    conditions, loops = _conditions(ctx), _loops(ctx)
    found = run_samples(run_loops, _samples(ctx, conditions, loops), ctx, "skies")
    rows = [_row(ctx.config, conditions, loop, index, found) for index, loop in enumerate(loops)]
    open_loop_nm = _stacked(found, "drift_nm")[:, :, ctx.config.settle :]
    results = Results(
        drift=conditions.drift,
        sky_focus_nm=_sky_focus_nm(found),
        open_loop_nm=float(np.sqrt(np.mean(open_loop_nm**2))),
        largest_stable_gain=Integrator(1.0, 1.0, ctx.config.delay).largest_stable_gain,
        default=DEFAULT,
        delay=ctx.config.delay,
        loops=rows,
    )
    return StageOutput(_arrays(found), results, checks_of(results), summary=_summary(rows))


# -- what is run -----------------------------------------------------------------------------------


def _conditions(ctx: StageContext[Config]) -> Conditions:
    config, facility = ctx.config, ctx.instrument.facility
    drift = SodiumLayer(**config.layer.model_dump()).drift(facility.pupil.diameter_m)
    read = Read.of(ctx.instrument, config.noise, NAME)
    return Conditions(facility, drift, config.delay, config.seeing_arcsec, config.calibration_frames, read)


def _loops(ctx: StageContext[Config]) -> tuple[Loop, ...]:
    """Every star in every configuration at its best gain, and the scans; each loop once."""
    config, conditions = ctx.config, _conditions(ctx)
    loops = [
        loop
        for name in config.configurations
        for loop in at_best_gain(
            name, config.magnitudes, conditions.drift, config.delay, noise_law(conditions, name)
        )
    ]
    if config.half_rate:
        noise = noise_law(conditions)
        loops += at_best_gain(DEFAULT, config.magnitudes, conditions.drift, config.delay, noise, exposures=2)
    loops += gain_scan(DEFAULT, config.scan_magnitudes, config.scan_gains)
    return tuple(dict.fromkeys(loops))


def _samples(ctx: StageContext[Config], conditions: Conditions, loops: tuple[Loop, ...]) -> list[LoopSample]:
    config = ctx.config
    sensors = tuple(dict.fromkeys(loop.sensor for loop in loops))
    return [
        LoopSample(
            f"sky {index}", (ctx.seed, index), conditions, sensors, loops, config.frames, config.drifts
        )
        for index in range(config.skies)
    ]


# -- what came out ---------------------------------------------------------------------------------


def _stacked(found: Sequence[Arrays], name: str) -> np.ndarray:
    return np.stack([one[name] for one in found])


def _row(config: Config, conditions: Conditions, loop: Loop, index: int, found: Sequence[Arrays]) -> LoopRow:
    """One loop: what theory expects and what happened."""
    residual_nm, measured_nm, true_nm, due = (
        _stacked(found, name)[:, :, index] for name in ("residual_nm", "measured_nm", "true_nm", "due")
    )
    outcome = outcome_of(residual_nm, measured_nm, true_nm, due, conditions.drift, config.settle)
    bound_nm, photon_noise_nm = (
        float(np.median(_stacked(found, name)[:, index])) for name in ("bound_nm", "photon_noise_nm")
    )
    theory = _theory(conditions, loop, outcome, photon_noise_nm, _sky_focus_nm(found))
    return LoopRow(**asdict(loop), **outcome.model_dump(), **theory, bound_nm=bound_nm)


def _theory(
    conditions: Conditions, loop: Loop, outcome: LoopOutcome, photon_noise_nm: float, sky_focus_nm: float
) -> dict[str, Any]:
    integrator = Integrator(loop.gain, float(loop.exposures), conditions.delay)
    noise_nm = float(np.hypot(photon_noise_nm, sky_focus_nm / np.sqrt(loop.exposures)))
    return {
        "expected_noise_nm": noise_nm,
        "predicted_nm": integrator.residual_nm(conditions.drift, noise_nm),
        "best_gain": best_gain(conditions.drift, noise_nm, float(loop.exposures), conditions.delay),
        "gain_margin": integrator.gain_margin(outcome.slope),
    }


def _sky_focus_nm(found: Sequence[Arrays]) -> float:
    focus = _stacked(found, "sky_focus_nm")
    return float(np.sqrt(np.mean(np.var(focus, axis=1, ddof=1))))


def _arrays(found: Sequence[Arrays]) -> dict[str, Quantity]:
    return {
        "residual_nm": Quantity(
            _stacked(found, "residual_nm"), "nm", "residual defocus (sky, drift, loop, frame of 1 s)"
        ),
        "drift_nm": Quantity(
            _stacked(found, "drift_nm"), "nm", "defocus of the sodium layer (sky, drift, frame)"
        ),
        "sky_focus_nm": Quantity(
            _stacked(found, "sky_focus_nm"), "nm", "defocus of the AO residual (sky, frame)"
        ),
    }


def _summary(rows: Sequence[LoopRow]) -> list[str]:
    lines = ["sensor           m_J  gain   residual (predicted)   bias   lost  margin"]
    for row in rows:
        rate = "" if row.exposures == 1 else f"  {row.exposures} s"
        lines.append(
            f"  {row.sensor:14s} {row.mag_j:4.1f}  {row.gain:.2f}  {row.residual_nm:6.1f} "
            f"({row.predicted_nm:.1f}) nm  {row.bias_nm:5.1f} nm  {row.lost:4.0%}  "
            f"{row.gain_margin:4.1f}{rate}"
        )
    return lines
