"""Stage `methods`: calibration methods compared on simulated cubes, at several seeings and AO residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE, PUBLISHED, VARIANTS
from irlos_pipe.paper.methods.checks import checks_of
from irlos_pipe.paper.methods.experiment import Sample, compare, speckle_floor_nm
from irlos_pipe.paper.methods.results import ConditionRow, Distribution
from irlos_pipe.paper.methods.results import MethodsResults as Results
from irlos_pipe.product.product import Quantity
from irlos_pipe.simulate.atmosphere import Shape
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 6
READS = ()
DEPENDS_ON = ("instrument", "seed")
MODEL_SHAPE: Shape = "power_law"  # what the model assumes, up to slope and direction
OTHER_SHAPES: tuple[Shape, ...] = ("servo_lag", "aliasing", "non_stationary")
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
    shapes: tuple[Shape, ...] = Field(OTHER_SHAPES, description="AO residuals of a shape the model has not")
    samples_of_shapes: int = Field(8, ge=0, le=1000, description="cubes of each shape at each seeing")
    frames: int = Field(300, ge=10, le=10000, description="frames of a cube")
    fractions: tuple[float, ...] = Field(
        (0.25, 0.5), min_length=1, description="parts of a cube, for the speckle floor"
    )
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate all cubes, calibrate each in every way, and summarise every condition."""
    samples = list(_samples(ctx))
    found = run_samples(compare, samples, ctx, "cubes")
    conditions = _conditions(samples, found)
    labels = {name: variant.label for name, variant in VARIANTS.items()}
    results = Results(conditions=conditions, labels=labels)
    return StageOutput(_arrays(samples, found), results, checks_of(results), summary=_summary(conditions))


def _samples(ctx: StageContext[Config]) -> Iterator[Sample]:
    config = ctx.config
    methods = (DEFAULT, *PUBLISHED)
    for seeing in config.seeings_arcsec:
        for index, cube in enumerate(_cubes(ctx, seeing, MODEL_SHAPE, config.samples)):
            if index < config.samples_of_parts:
                yield Sample(cube, (*PARTS, *PUBLISHED), config.fractions)
            else:
                yield Sample(cube, methods)
    for seeing in config.between_arcsec:
        for cube in _cubes(ctx, seeing, MODEL_SHAPE, config.samples_between):
            yield Sample(cube, methods)
    for shape in config.shapes:
        for seeing in config.seeings_arcsec:
            for cube in _cubes(ctx, seeing, shape, config.samples_of_shapes):
                yield Sample(cube, (DEFAULT, PAPER_CHOICE))


def _cubes(ctx: StageContext[Config], seeing: float, shape: Shape, count: int) -> Iterator[CubeSample]:
    """Cubes of one condition; the n-th of every condition has the same NCPAs."""
    for index in range(count):
        yield CubeSample(
            f"{shape}, {seeing:g} arcsec, cube {index}",
            (ctx.seed, index),
            ctx.instrument.facility,
            seeing,
            ctx.config.frames,
            ctx.config.mag_j,
            shape=shape,
        )


def _conditions(samples: Sequence[Sample], found: Sequence[Arrays]) -> list[ConditionRow]:
    """One row per shape and seeing, with the distribution of every variant."""
    by_condition: dict[tuple[str, float], list[Arrays]] = {}
    for sample, one in zip(samples, found, strict=True):
        by_condition.setdefault((sample.cube.shape, sample.cube.seeing_arcsec), []).append(one)
    return [_condition(shape, seeing, of_it) for (shape, seeing), of_it in by_condition.items()]


def _condition(shape: str, seeing: float, found: Sequence[Arrays]) -> ConditionRow:
    methods = [name for name in VARIANTS if all(f"{name}/modes_nm" in one for one in found)]
    introduced_nm = _values(found, "introduced_nm")
    dissected = [one for one in found if f"{PARTS[-1]}/modes_nm" in one]
    return ConditionRow(
        shape=shape,
        seeing_arcsec=seeing,
        samples=len(found),
        introduced_nm=float(np.mean(introduced_nm)),
        introduced_scatter_nm=float(np.std(introduced_nm)),
        modes={name: _distribution(found, f"{name}/modes_nm") for name in methods},
        pupil={name: _distribution(found, f"{name}/pupil_nm") for name in methods},
        ratio_to_dip_global=_ratio(found),
        **(_parts(dissected) if dissected else {}),
    )


def _parts(found: Sequence[Arrays]) -> dict[str, Any]:
    """What each part of the default contributes, on the cubes where all were changed in turn."""
    floor_nm, rest_nm = _floor(found)
    return {
        "parts": {name: _distribution(found, f"{name}/modes_nm") for name in PARTS},
        "chi2_nu": {name: float(np.median(_values(found, f"{name}/chi2_nu"))) for name in PARTS},
        "speckle_floor_nm": floor_nm,
        "beside_floor_nm": rest_nm,
    }


def _values(found: Sequence[Arrays], key: str) -> list[float]:
    """Values of all cubes that have this one."""
    return [float(one[key]) for one in found if key in one]


def _distribution(found: Sequence[Arrays], key: str) -> Distribution:
    return Distribution.of(_values(found, key))


def _ratio(found: Sequence[Arrays]) -> float:
    """Median Δ-WFE in the 29 modes of the default over that of the paper's choice."""
    default, baseline = (np.median(_values(found, f"{name}/modes_nm")) for name in (DEFAULT, PAPER_CHOICE))
    return float(default / baseline)


def _floor(found: Sequence[Arrays]) -> tuple[float, float]:
    keys = {key for key in found[0] if key.startswith("fraction_")}
    parts = {float(key.removeprefix("fraction_").removesuffix("/modes_nm")): key for key in keys}
    parts[1.0] = f"{DEFAULT}/modes_nm"
    return speckle_floor_nm({part: _values(found, key) for part, key in parts.items()})


def _arrays(samples: Sequence[Sample], found: Sequence[Arrays]) -> dict[str, Quantity]:
    """One row per sample; NaN where a variant was not run on it."""
    keys = sorted({key for one in found for key in one})
    arrays = {
        f"samples/{key}": Quantity(
            np.array([float(one.get(key, np.nan)) for one in found]), "nm" if key.endswith("_nm") else "", key
        )
        for key in keys
    }
    seeing = np.array([sample.cube.seeing_arcsec for sample in samples])
    shape = np.array([sample.cube.shape for sample in samples], dtype=object)
    return arrays | {
        "samples/seeing_arcsec": Quantity(seeing, "arcsec", "seeing"),
        "samples/shape": Quantity(shape, "", "AO residual"),
    }


def _summary(conditions: Sequence[ConditionRow]) -> list[str]:
    lines = ["Δ-WFE in Noll 2–30, median over cubes: default / DIP global"]
    for row in conditions:
        default, baseline = (row.modes[name].median_nm for name in (DEFAULT, PAPER_CHOICE))
        lines.append(
            f'  {row.shape:15s} {row.seeing_arcsec:4.2f}"  {default:5.1f} / {baseline:5.1f} nm'
            f" = {row.ratio_to_dip_global:.2f}  ({row.samples} cubes)"
        )
    return lines
