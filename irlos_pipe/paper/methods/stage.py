"""Stage `methods`: calibration methods compared on simulated cubes, at several seeings and AO residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.variants import DEFAULT, PUBLISHED, VARIANTS
from irlos_pipe.paper.methods.experiment import Distribution, Sample, compare, speckle_floor_nm
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = "methods"
VERSION = 4
READS = ()
DEPENDS_ON = ("instrument", "seed")
MODEL_SHAPE = "power_law"  # what the model assumes, up to slope and direction
OTHER_SHAPES = ("servo_lag", "aliasing", "non_stationary")
BASELINE = "dip_global"  # the paper's choice
DIRECTIONS = ("elliptic_residual", "round_residual")
PARTS = tuple(name for name in VARIANTS if name not in PUBLISHED)


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(20, ge=1, le=1000, description="cubes at each of `seeings_arcsec`")
    samples_of_parts: int = Field(
        6, ge=0, le=1000, description="of these, cubes with parts of the default changed"
    )
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), description="seeings with all methods")
    between_arcsec: tuple[float, ...] = Field((0.5, 0.7), description="further seeings of the figure")
    samples_between: int = Field(4, ge=0, le=1000, description="cubes at each of `between_arcsec`")
    shapes: tuple[str, ...] = Field(OTHER_SHAPES, description="AO residuals of a shape the model has not")
    samples_of_shapes: int = Field(8, ge=0, le=1000, description="cubes of each shape at each seeing")
    frames: int = Field(300, ge=10, le=10000, description="frames of a cube")
    fractions: tuple[float, ...] = Field(
        (0.25, 0.5), min_length=1, description="parts of a cube, for the speckle floor"
    )
    mag_j: float = Field(7.0, ge=0, le=20)


def run(ctx: StageContext) -> StageOutput:
    """Simulate all cubes, calibrate each in every way, and sum up per condition."""
    samples = list(_samples(ctx))
    numbers = run_samples(compare, samples, ctx, "cubes")
    conditions = _conditions(samples, numbers)
    results = {"conditions": conditions, "labels": {name: VARIANTS[name].label for name in VARIANTS}}
    return StageOutput(_arrays(samples, numbers), results, summary=_summary(conditions))


def _samples(ctx: StageContext) -> Iterator[Sample]:
    config: Config = ctx.config
    for seeing in config.seeings_arcsec:
        cubes = list(_cubes(ctx, seeing, MODEL_SHAPE, config.samples, (DEFAULT, *PUBLISHED)))
        every = (*PARTS, *PUBLISHED)
        for cube in cubes[: config.samples_of_parts]:
            yield replace(cube, variants=every, fractions=config.fractions)
        yield from cubes[config.samples_of_parts :]
    for seeing in config.between_arcsec:
        yield from _cubes(ctx, seeing, MODEL_SHAPE, config.samples_between, (DEFAULT, *PUBLISHED))
    for shape in config.shapes:
        for seeing in config.seeings_arcsec:
            yield from _cubes(ctx, seeing, shape, config.samples_of_shapes, (DEFAULT, BASELINE, *DIRECTIONS))


def _cubes(
    ctx: StageContext, seeing: float, shape: str, count: int, variants: tuple[str, ...]
) -> Iterator[Sample]:
    """Cubes of one condition; the n-th of every condition has the same NCPAs."""
    for index in range(count):
        yield Sample(
            f"{shape}, {seeing:g} arcsec, cube {index}",
            (ctx.seed, index),
            ctx.instrument.facility,
            seeing,
            shape,
            ctx.config.frames,
            variants,
            (),
            ctx.config.mag_j,
        )


def _conditions(samples: Sequence[Sample], numbers: Sequence[Arrays]) -> list[dict]:
    """One entry per seeing and shape, with the distribution of every variant."""
    keys = dict.fromkeys((s.shape, s.seeing_arcsec) for s in samples)
    rows = []
    for shape, seeing in keys:
        of_it = [
            n for s, n in zip(samples, numbers, strict=True) if (s.shape, s.seeing_arcsec) == (shape, seeing)
        ]
        rows.append({"shape": shape, "seeing_arcsec": seeing, **_condition(of_it)})
    return rows


def _condition(numbers: Sequence[Arrays]) -> dict:
    methods = [name for name in VARIANTS if all(f"{name}/modes_nm" in n for n in numbers)]
    row = {
        "samples": len(numbers),
        "introduced_nm": float(np.mean([n["introduced_nm"] for n in numbers])),
        "introduced_scatter_nm": float(np.std([n["introduced_nm"] for n in numbers])),
        "modes": {name: _distribution(numbers, f"{name}/modes_nm") for name in methods},
        "pupil": {name: _distribution(numbers, f"{name}/pupil_nm") for name in methods},
        "ratio_to_dip_global": _ratio(numbers),
    }
    dissected = [n for n in numbers if f"{PARTS[-1]}/modes_nm" in n]
    return row | (_parts(dissected) if dissected else {})


def _parts(numbers: Sequence[Arrays]) -> dict:
    """What each part of the default buys, on the cubes where all were left out in turn."""
    floor = _floor(numbers)
    return {
        "parts": {name: _distribution(numbers, f"{name}/modes_nm") for name in PARTS},
        "chi2_nu": {name: float(np.median(_values(numbers, f"{name}/chi2_nu"))) for name in PARTS},
        "speckle_floor_nm": floor[0],
        "beside_floor_nm": floor[1],
    }


def _values(numbers: Sequence[Arrays], key: str) -> list[float]:
    """Values of all cubes that have this one."""
    return [float(n[key]) for n in numbers if key in n]


def _distribution(numbers: Sequence[Arrays], key: str) -> dict[str, float]:
    return asdict(Distribution.of(_values(numbers, key)))


def _ratio(numbers: Sequence[Arrays]) -> float:
    """Median Δ-WFE in the 29 modes of the default over that of the paper's choice."""
    default, baseline = (np.median([n[f"{name}/modes_nm"] for n in numbers]) for name in (DEFAULT, BASELINE))
    return float(default / baseline)


def _floor(numbers: Sequence[Arrays]) -> tuple[float, float]:
    keys = {key for key in numbers[0] if key.startswith("fraction_")}
    parts = {float(key.removeprefix("fraction_").removesuffix("/modes_nm")): key for key in keys}
    parts[1.0] = f"{DEFAULT}/modes_nm"
    return speckle_floor_nm({part: _values(numbers, key) for part, key in parts.items()})


def _arrays(samples: Sequence[Sample], numbers: Sequence[Arrays]) -> dict[str, Quantity]:
    """One row per sample; NaN where a variant was not run on it."""
    keys = sorted({key for n in numbers for key in n})
    arrays = {
        f"samples/{key}": Quantity(
            np.array([float(n.get(key, np.nan)) for n in numbers]), "nm" if key.endswith("_nm") else "", key
        )
        for key in keys
    }
    arrays["samples/seeing_arcsec"] = Quantity(
        np.array([s.seeing_arcsec for s in samples]), "arcsec", "seeing"
    )
    arrays["samples/shape"] = Quantity(np.array([s.shape for s in samples], dtype=object), "", "AO residual")
    return arrays


def _summary(conditions: Sequence[dict]) -> list[str]:
    lines = ["Δ-WFE in Noll 2–30, median over cubes: default / DIP global"]
    for row in conditions:
        default, baseline = (row["modes"][name]["median_nm"] for name in (DEFAULT, BASELINE))
        lines.append(
            f'  {row["shape"]:15s} {row["seeing_arcsec"]:4.2f}"  {default:5.1f} / {baseline:5.1f} nm'
            f" = {row['ratio_to_dip_global']:.2f}  ({row['samples']} cubes)"
        )
    return lines
