"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from irlos_pipe.conventions.late import LateModule
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.calibration_options import (
    DEFAULT_METHOD,
    METHODS,
    OPEN,
    CalibrationOptions,
    MethodName,
    NcpaPrior,
    OptimiserName,
)
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.product.results import item
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.calibrate.results import ARRAYS, CHECKS
from irlos_pipe.stages.calibrate.results import CalibrateResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "calibrate"
VERSION = 28
NEEDS = ("ingest",)
READS = ("ingest",)
WORK = LateModule("irlos_pipe.stages.calibrate.work")
ClosedNoll = Annotated[int, Field(ge=4, le=HIGHEST_NOLL)]


class Limits(StageConfig):
    """Limits of the quality control, part of the stage's settings."""

    max_chi2_nu: float | None = item(
        None,
        "QC limit on the reduced chi-square of the mean image; null: by its nominal value, which "
        "the scatter of the frames tells",
        gt=0,
    )
    max_error_nm: float = item(
        12.0, "QC limit on the quoted error of Noll 4-30 behind an AO system [nm RMS]", gt=0
    )
    min_converged: float = item(0.9, "QC limit on the part of fits that converge", ge=0, le=1)
    min_frames: int = item(8, "QC limit on the frames where they scatter by more than noise", ge=1)
    max_motion: float = item(
        0.25, "QC limit on how far the star moves, over the smaller window side", gt=0, le=1
    )
    min_window: float = item(8.0, "QC limit on the smaller side of the window, in λ/D", ge=0)


class Config(Limits):
    """Settings of the calibration."""

    input: str = item("calibration", "recipe input that holds the cubes")
    each: bool = item(False, "calibrate every recording by itself instead of all together")
    method: MethodName = item(
        DEFAULT_METHOD, "calibration method: which images are fitted, and by how many wavefronts"
    )
    loss: LossName | None = item(
        CalibrationOptions.loss,
        "loss function (l1 is rounded within 1 sigma, huber within 2); null: that of the method",
    )
    optimiser: OptimiserName = item(
        CalibrationOptions.optimiser, "solver: Levenberg-Marquardt, or L-BFGS with autograd"
    )
    highest_noll: ClosedNoll | Literal["open"] | None = item(
        CalibrationOptions.highest_noll,
        "highest Noll mode estimated, from 2 on; open: all that the window shows, by a prior "
        "whose law is fitted; null: that of the method, open for long_exposure",
    )
    prior_scale: float | None = item(
        3.0, "width of the prior over that of the NCPA law; null: no prior", gt=0, le=1000
    )
    max_iterations: int = item(
        CalibrationOptions.max_iterations, "largest number of iterations of a fit", ge=1, le=10000
    )
    compare: tuple[MethodName, ...] = item((), "further methods to run, for comparison in the report only")

    @model_validator(mode="after")
    def _can_be_open(self) -> Config:
        if self.highest_noll == OPEN and not METHODS[self.method].open:
            raise ValueError(
                f"'highest_noll: open' is not for method '{self.method}'; give a number, or null"
            )
        return self

    @model_validator(mode="after")
    def _compared_on_all(self) -> Config:
        if self.each and self.compare:
            raise ValueError("'compare' works on all recordings together; leave it out with 'each: true'")
        return self

    def options(self, ncpa_law: NcpaLaw, method: str | None = None) -> CalibrationOptions:
        """Options of the configured method with a prior from `ncpa_law`.

        Or those of another `method` as published: own loss, own modes, no prior.
        """
        if method is not None:
            return CalibrationOptions(method, max_iterations=self.max_iterations)
        return CalibrationOptions(
            self.method,
            self.loss,
            self.optimiser,
            self.highest_noll,
            None if self.prior_scale is None else NcpaPrior(ncpa_law, self.prior_scale),
            self.max_iterations,
            ncpa_law,
        )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate with the chosen method, and with the methods to compare."""
    return WORK.run(ctx)
