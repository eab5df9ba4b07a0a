"""Stage `lift`: tip, tilt and defocus of every frame of a ramp, the NCPAs in the known wavefront."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from irlos_pipe.conventions.late import LateModule
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.lift_options import LiftOptions, NoiseSource
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.product.results import item
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.lift.results import ARRAYS, CHECKS
from irlos_pipe.stages.lift.results import LiftResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "lift"
VERSION = 18
NEEDS = ("ingest",)
READS = ("ingest", "prior", "calibrate")
WORK = LateModule("irlos_pipe.stages.lift.work")
Mode = Annotated[int, Field(ge=2, le=HIGHEST_NOLL)]
# "told" is the former spelling of "commanded".
Start = Annotated[
    Literal["elongation", "scan", "commanded", "zero"],
    BeforeValidator(lambda value: "commanded" if value == "told" else value),
]
ObjectSigma = Literal["calibrated", "fit"] | Annotated[float, Field(ge=0, le=200)]


class Config(StageConfig):
    """Settings of LIFT."""

    input: str = item("ramp", "recipe input that holds the ramp")
    modes: tuple[Mode, ...] = item((2, 3, 4), "Noll modes to estimate; 4 (defocus) among them")
    common_modes: tuple[Annotated[int, Field(le=HIGHEST_NOLL)], ...] = item(
        (),
        "Noll modes of a static wavefront that all frames share, fitted to the ramp by phase "
        "diversity; instead of a calibration",
    )
    calibrated: bool = item(True, "make the NCPAs of `calibrate` a part of the known wavefront")
    halo: Literal["calibrated", "fit", "off"] = item(
        "calibrated", "AO residual in the model: as calibrated, fitted to the ramp, or none"
    )
    object_sigma_mas: ObjectSigma = item(
        "calibrated",
        "width of the kernel of object and jitter: a number [mas], as calibrated, or fitted to the ramp",
    )
    own_wavefront: Literal["auto", "always", "never"] = item(
        "auto",
        "fit what another filter or lens than the calibration's adds to the wavefront, by "
        "wavelength (chromatic_ncpa) and by itself (filter_ncpa): where the frames misfit, always or never",
    )
    estimator: Literal["ml", "map"] = item("ml", "maximum likelihood, or with a Gaussian prior")
    prior_scale: float = item(3.0, "width of the prior of MAP over that of the NCPA law", gt=0, le=1000)
    noise: NoiseSource = item(
        LiftOptions.noise,
        "variances of the pixels: from the data, from the start's model, or renewed with the fit",
    )
    loss: LossName = item(
        LiftOptions.loss,
        "loss function: the likelihood, huber (linear beyond 2 sigma: single wrong pixels count "
        "little), or the l1 of the paper's DIP; these two take the variances of the start's model",
    )
    start: Start = item(
        "elongation",
        "where the iteration begins: at the elongation prior, at the best of a scan of defocus, at the "
        "commanded defocus (needed without diversity, where the sign of defocus is ambiguous), or at zero",
    )
    max_iterations: int = item(
        LiftOptions.max_iterations, "largest number of iterations of a fit", ge=1, le=1000
    )
    singly: bool = item(
        False,
        "measure every frame by itself from a scan of defocus, to the bit as irlos focus does; "
        "modes 2, 3, 4 and nothing fitted to the ramp",
    )
    compare: bool = item(
        True,
        "repeat without the NCPAs and without the AO residual, and one frame at every defocus, "
        "for the report",
    )
    min_converged: float = item(0.9, "QC limit on the part of frames that converge", ge=0, le=1)
    max_residual_nm: float = item(30.0, "QC limit on the scatter about the straight line [nm RMS]", gt=0)
    max_slope_error: float = item(
        0.05, "QC limit on the slope's departure from 1; 5 of its standard errors if more", gt=0
    )
    max_error_nm: float = item(
        30.0, "QC limit on estimated minus introduced defocus, with NCPAs [nm RMS]", gt=0
    )
    max_chi2_ratio: float = item(
        1.75, "QC limit on the median chi-square of the frames over its nominal value", gt=1
    )
    unknown_nominal_chi2_nu: float = item(
        3.0, "nominal chi-square of a frame where no offset has two frames", gt=0
    )

    @model_validator(mode="after")
    def _common_modes_are_not_estimated_twice(self) -> Config:
        twice = sorted({*self.common_modes} & {*self.modes})
        if twice:
            raise ValueError(f"mode {twice[0]} is both in 'modes' and in 'common_modes'; name it once")
        if min(self.common_modes, default=2) < 2:
            raise ValueError("'common_modes' are Noll modes from 2 on")
        return self

    @model_validator(mode="after")
    def _singly_is_what_the_loop_does(self) -> Config:
        fitted = self.halo == "fit" or self.object_sigma_mas == "fit" or bool(self.common_modes)
        other = sorted(self.modes) != [2, 3, 4] or self.estimator != "ml" or self.loss != "gaussian"
        if self.singly and (fitted or other):
            raise ValueError(
                "'singly' takes modes 2, 3 and 4, estimator 'ml', loss 'gaussian', and nothing that is "
                "fitted to the ramp"
            )
        return self


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate the ramp, and repeat it with parts of the model left out to show what each contributes."""
    return WORK.run(ctx)
