"""Stage `faint`: how faint LIFT goes, by simulated frames dimmed as in the paper's test."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion, Curve
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS
from irlos_pipe.paper.common.reads import NoiseOf, Read
from irlos_pipe.paper.common.seeing import on_spartas_scale
from irlos_pipe.paper.faint.checks import checks_of
from irlos_pipe.paper.faint.experiment import (
    COMPARED,
    Exposures,
    FaintSample,
    dim_and_estimate,
    pooled,
    residual_floor_nm,
)
from irlos_pipe.paper.faint.results import ExposureGroup, FaintCriterion, VariantCurve
from irlos_pipe.paper.faint.results import FaintResults as Results
from irlos_pipe.product.declared import declared
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.sensitivity.stage import CURVE

NAME = Results.stage
VERSION = 9
READS = ()
DEPENDS_ON = ("instrument", "seed")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(2, ge=1, le=1000, description="sets of NCPAs, pooled in every curve")
    reach_nm: float = Field(170.0, gt=0, le=600, description="the ramp goes from minus to plus this [nm RMS]")
    offsets: int = Field(7, ge=2, le=200, description="positions of the ramp, one frame each")
    realisations: int = Field(10, ge=1, le=1000, description="of the noise, per frame and magnitude")
    exposures_s: tuple[float, ...] = Field((0.1, 1.0), min_length=1, description="lengths of an exposure")
    faintest_mag_j: tuple[float, ...] = Field((19.0, 21.0), description="for each length of exposure")
    magnitudes: int = Field(9, ge=1, le=50, description="of the scan, the faintest one included")
    mag_step: float = Field(1.0, gt=0, le=5, description="step of the magnitudes")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    mag_j: float = Field(7.1, ge=0, le=20, description="of the frames that are dimmed")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="by MASS-DIMM")
    limit_nm: float = Field(30.0, gt=0, description="limiting magnitude: largest median error [nm RMS]")
    limit_failures: float = Field(0.1, ge=0, le=1, description="limiting magnitude: largest part of failures")
    noise: NoiseOf = Field(
        "reads", description="of the dimmed frames: all reads of an exposure with sky and dark, or one read"
    )

    @model_validator(mode="after")
    def _usable_magnitudes(self) -> Config:
        if len(self.faintest_mag_j) != len(self.exposures_s):
            raise ValueError("faintest_mag_j needs one value for each of exposures_s")
        brightest = min(self.faintest_mag_j) - (self.magnitudes - 1) * self.mag_step
        if brightest < self.mag_j:
            raise ValueError(
                f"the scan would begin at {brightest:g}, brighter than mag_j {self.mag_j:g}: frames can only "
                "be dimmed; lower magnitudes or mag_step"
            )
        return self

    def scans(self) -> tuple[Exposures, ...]:
        """Return the lengths of exposure with their magnitudes, bright to faint."""
        steps = np.arange(self.magnitudes)[::-1] * self.mag_step
        return tuple(
            Exposures(exposure_s, tuple((faintest - steps).tolist()))
            for exposure_s, faintest in zip(self.exposures_s, self.faintest_mag_j, strict=True)
        )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Dim and estimate the ramps of all samples; one group of curves per length of exposure."""
    config = ctx.config
    samples = [_sample(ctx, index) for index in range(config.samples)]
    found = run_samples(dim_and_estimate, samples, ctx, "samples")
    criterion = Criterion(config.limit_nm, config.limit_failures)
    groups = [_group(found, exposures, criterion) for exposures in config.scans()]
    results = Results(
        samples=len(found),
        exposures=groups,
        criterion=FaintCriterion(
            median_abs_error_nm=config.limit_nm,
            failures=config.limit_failures,
            implausible_nm=criterion.implausible_nm,
        ),
        crb_note=f"1 sigma; the median |error| of an efficient estimate is {MEDIAN_OF_NORMAL} of it",
    )
    return StageOutput(
        _arrays(groups), results, checks_of(results), summary=[_line(group) for group in groups]
    )


def _sample(ctx: StageContext[Config], index: int) -> FaintSample:
    config = ctx.config
    offsets = np.linspace(-config.reach_nm, config.reach_nm, config.offsets)
    return FaintSample(
        f"sample {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        config.scans(),
        tuple(offsets.tolist()),
        config.realisations,
        config.cube_frames,
        on_spartas_scale(ctx.instrument, config.seeing_arcsec),
        config.mag_j,
        Read.of(ctx.instrument, config.noise, NAME),
    )


def _group(found: list[Arrays], exposures: Exposures, criterion: Criterion) -> ExposureGroup:
    """Curves of all variants for one length of exposure."""
    return ExposureGroup(
        exposure_s=exposures.exposure_s,
        residual_floor_nm=residual_floor_nm(found, exposures),
        curves=[_curve(key, pooled(found, exposures, key, criterion), criterion) for key in COMPARED],
    )


def _curve(key: str, curve: Curve, criterion: Criterion) -> VariantCurve:
    variant = LIFT_VARIANTS[key]
    return VariantCurve(
        key=key,
        label=variant.name,
        modes=list(variant.modes),
        calibrated=bool(variant.ncpa),
        **{name: getattr(curve, name).tolist() for name in CURVE},
        trials=curve.trials,
        limit_mag=curve.limit_mag,
        one_read_bound_mag=curve.bound_mag(criterion),
    )


def _arrays(groups: list[ExposureGroup]) -> dict[str, Quantity]:
    arrays: dict[str, Quantity] = {}
    for group in groups:
        for curve in group.curves:
            values = {name: getattr(curve, name) for name in CURVE}
            note = f"{curve.label}, {len(curve.modes)} modes, {group.exposure_s:g} s"
            arrays |= declared(CURVE, values, note, below=f"{group.exposure_s:g}/{curve.key}/")
    return arrays


def _line(group: ExposureGroup) -> str:
    limits = ", ".join(f"{curve.key} {curve.limit_mag:.1f}" for curve in group.curves)
    return f"limiting m_J at {group.exposure_s:g} s: {limits}"
