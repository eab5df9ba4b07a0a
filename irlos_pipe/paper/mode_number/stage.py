"""Stage `mode_number`: error against the number of estimated modes on simulated cubes (paper, appendix B)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field, field_validator

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.reads import NoiseOf, Read
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE, frames_per_method
from irlos_pipe.paper.mode_number.checks import checks_of
from irlos_pipe.paper.mode_number.experiment import LIFT, NumberSample, errors_by_number
from irlos_pipe.paper.mode_number.results import ModeNumberResults as Results
from irlos_pipe.paper.mode_number.results import NumberCurve
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 5
READS = ()
DEPENDS_ON = ("instrument", "seed")
MODES_INTRODUCED = 50


class Config(StageConfig):
    """Sizes of the experiment."""

    cubes: int = Field(4, ge=1, le=1000, description="cubes, each with its own NCPAs of 50 modes")
    frames: int = Field(200, ge=32, le=10000, description="frames of a cube")
    published_frames: int = Field(
        20, ge=2, le=10000, description="the first frames, for the published method, which fits one by one"
    )
    numbers: tuple[int, ...] = Field(
        (16, 21, 31, 41, 51, 61, 81, 101), min_length=2, description="highest Noll modes estimated"
    )
    magnitudes: tuple[float, ...] = Field(
        (7.0, 14.0, 16.0, 18.0), min_length=1, description="of the star, in J"
    )
    seeing_arcsec: float = Field(0.5, gt=0, le=5, description="seeing on SPARTA's scale")
    noise: NoiseOf = Field("reads", description="of exposures: all reads with sky and dark, or one read")

    @field_validator("numbers")
    @classmethod
    def _rising(cls, numbers: tuple[int, ...]) -> tuple[int, ...]:
        if list(numbers) != sorted(set(numbers)) or numbers[0] < 4 or numbers[-1] > HIGHEST_NOLL:
            raise ValueError(f"give rising numbers between 4 and {HIGHEST_NOLL}")
        return numbers


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate few and many modes in every cube by every method and at every magnitude."""
    found = run_samples(errors_by_number, list(_samples(ctx)), ctx, "cubes")
    curves = [
        _curve(ctx.config, method, mag_j, [one[f"{method}/error_nm"][place] for one in found])
        for method, magnitudes in _magnitudes(ctx.config).items()
        for place, mag_j in enumerate(magnitudes)
    ]
    results = Results(
        cubes=len(found),
        modes_introduced=MODES_INTRODUCED,
        highest_noll=list(ctx.config.numbers),
        curves=curves,
        recommended_noll=[int(one["recommended_noll"]) for one in found],
    )
    return StageOutput(_arrays(ctx.config, found), results, checks_of(results), summary=_lines(results))


def _magnitudes(config: Config) -> dict[str, tuple[float, ...]]:
    """The paper's calibration is meant for bright stars only."""
    return {DEFAULT: config.magnitudes, PAPER_CHOICE: config.magnitudes[:1], LIFT: config.magnitudes}


def _samples(ctx: StageContext[Config]) -> Iterator[NumberSample]:
    config = ctx.config
    frames = frames_per_method(config.frames, config.published_frames) | {LIFT: config.frames}
    read = Read.of(ctx.instrument, config.noise, NAME)
    for index in range(config.cubes):
        cube = CubeSample(
            f"cube {index}",
            (ctx.seed, index),
            ctx.instrument.facility,
            config.seeing_arcsec,
            config.frames,
            config.magnitudes[0],
        )
        yield NumberSample(cube, config.numbers, _magnitudes(config), frames, read)


def _curve(config: Config, method: str, mag_j: float, errors_nm: Sequence[np.ndarray]) -> NumberCurve:
    """Median and extremes over the cubes."""
    median = np.median(errors_nm, axis=0)
    return NumberCurve(
        method=method,
        mag_j=mag_j,
        median_nm=median.tolist(),
        least_nm=np.min(errors_nm, axis=0).tolist(),
        worst_nm=np.max(errors_nm, axis=0).tolist(),
        best_noll=config.numbers[int(np.argmin(median))],
        best_nm=float(median.min()),
    )


def _arrays(config: Config, found: Sequence[Arrays]) -> dict[str, Quantity]:
    arrays = {
        f"{method}/error_nm": Quantity(
            np.stack([one[f"{method}/error_nm"] for one in found]),
            "nm",
            "Δ-WFE in Noll 2–30 (cube, magnitude, number)",
        )
        for method in _magnitudes(config)
    }
    held_out = np.stack([one["held_out"] for one in found])
    return arrays | {
        "highest_noll": Quantity(np.array(config.numbers), "", "modes Noll 2 to this"),
        "magnitude": Quantity(np.array(config.magnitudes), "mag", "of the star, in J"),
        "held_out": Quantity(held_out, "", "χ²/ν of unseen frames, default, bright star (cube, number)"),
    }


def _lines(results: Results) -> list[str]:
    lines = ["Best number of modes (Δ-WFE in Noll 2–30, median over cubes):"]
    lines += [
        f"  {one.method:14s} m_J {one.mag_j:4.1f}: Noll 2–{one.best_noll}, {one.best_nm:.1f} nm"
        for one in results.curves
    ]
    recommended = ", ".join(str(noll) for noll in results.recommended_noll)
    return [*lines, f"  unseen frames recommend, cube by cube: {recommended}"]
