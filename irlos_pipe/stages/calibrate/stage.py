"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.calibration import OPEN, Calibration, CalibrationOptions, OptimiserName, calibrate
from irlos_pipe.estimate.methods import DEFAULT_METHOD, METHODS, MethodName
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.estimate.setups import calibrate_setups
from irlos_pipe.frames.recording import Recording
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.input import cube_input, require_calibration
from irlos_pipe.stages.calibrate.output import joint_output, wfe_nm
from irlos_pipe.stages.calibrate.per_recording import Cube, each_output
from irlos_pipe.stages.calibrate.quality import Limits
from irlos_pipe.stages.calibrate.setups import by_setup, require_joint, setups_of
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.recording_settings import SETUP_KEYS, differences, seeing_arcsec

NAME = "calibrate"
VERSION = 11
NEEDS = ("ingest",)
READS = ("ingest",)
ClosedNoll = Annotated[int, Field(ge=4, le=231)]


class Config(Limits):
    """Settings of the calibration."""

    input: str = Field("calibration", description="recipe input that holds the cubes")
    each: bool = Field(False, description="calibrate every recording by itself instead of all together")
    method: MethodName = Field(
        DEFAULT_METHOD,
        description="calibration method: which images are fitted, and by how many wavefronts",
    )
    loss: LossName | None = Field(
        CalibrationOptions.loss,
        description="loss function (l1 is rounded within 1 sigma, huber within 2); null: that of the method",
    )
    optimiser: OptimiserName = Field(
        CalibrationOptions.optimiser, description="solver: Levenberg-Marquardt, or L-BFGS with autograd"
    )
    highest_noll: ClosedNoll | Literal["open"] | None = Field(
        CalibrationOptions.highest_noll,
        description="highest Noll mode estimated, from 2 on; open: all that the window shows, by a prior "
        "whose law is fitted; null: that of the method, open for long_exposure",
    )
    prior_scale: float | None = Field(
        3.0, gt=0, le=1000, description="width of the prior over that of the NCPA law; null: no prior"
    )
    max_iterations: int = Field(
        CalibrationOptions.max_iterations, ge=1, le=10000, description="largest number of iterations of a fit"
    )
    compare: tuple[MethodName, ...] = Field(
        (), description="further methods to run, for comparison in the report only"
    )

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
    recordings = [r.accepted() for r in recordings_from_product(ctx.products["ingest"], ctx.config.input)]
    for alike in [[one] for one in recordings] if ctx.config.each else [recordings]:
        require_calibration(alike)
    return _each(ctx, recordings) if ctx.config.each else _together(ctx, recordings)


def _together(ctx: StageContext[Config], recordings: list[Recording]) -> StageOutput:
    used = [r for r in recordings if r.frames]
    if not used:
        raise InputDataError(_no_frame(recordings[0]))
    if any(differences(used[0], other, SETUP_KEYS) for other in used[1:]):
        return _jointly(ctx, used)
    result = _calibrate(ctx, recordings, ctx.config.options(ctx.instrument.facility.ncpa_law))
    others = [
        _calibrate(ctx, recordings, ctx.config.options(ctx.instrument.facility.ncpa_law, method))
        for method in ctx.config.compare
        if method != ctx.config.method
    ]
    first = recordings[0].acquisition
    seeing = seeing_arcsec(ctx.instrument, first)
    return joint_output(ctx.config, result, others, seeing, first)


def _jointly(ctx: StageContext[Config], recordings: list[Recording]) -> StageOutput:
    """One wavefront, and what of it belongs to wavelength, filter or lens, from several set-ups."""
    groups, options = by_setup(recordings), ctx.config.options(ctx.instrument.facility.ncpa_law)
    require_joint(ctx, groups, options.method)
    if ctx.config.compare:
        ctx.log.warning("calibrate.compare is left out: methods are compared on recordings of one set-up")
    result = calibrate_setups(setups_of(ctx, groups, options), options, device=ctx.device)
    ctx.log.info("%d set-ups together: chi2/nu %.2f, %.1f s", len(groups), result.chi2_nu, result.seconds)
    first = groups[0][0].acquisition
    return joint_output(ctx.config, result, [], seeing_arcsec(ctx.instrument, first), first)


def _each(ctx: StageContext[Config], recordings: list[Recording]) -> StageOutput:
    usable = [r for r in recordings if r.frames]
    failures = [_no_frame(r) for r in recordings if not r.frames]
    if not usable:
        raise InputDataError(failures[0])
    cubes = [
        Cube(
            r.name,
            r.acquisition,
            seeing_arcsec(ctx.instrument, r.acquisition),
            _calibrate(ctx, [r], ctx.config.options(ctx.instrument.facility.ncpa_law)),
        )
        for r in usable
    ]
    return each_output(ctx.config, cubes, failures)


def _no_frame(recording: Recording) -> str:
    return f"{recording.name}: no used frame is left to calibrate with"


def _calibrate(
    ctx: StageContext[Config], recordings: list[Recording], options: CalibrationOptions
) -> Calibration:
    """One method on all frames of the recordings."""
    first, cube = recordings[0], cube_input(ctx, recordings, options)
    total = options.scheme.fits(cube.frames)
    with ctx.progress(total=total, desc=f"calibrate {options.method}") as bar:
        result = calibrate(
            cube.frames, cube.settings, options, cube.effects, device=ctx.device, report=bar.update
        )
    ctx.log.info(
        "%s, %s: %.1f nm RMS, chi2/nu %.2f, %.1f s",
        first.name,
        options.method,
        wfe_nm(result.nolls, result.zernike_nm),
        result.chi2_nu,
        result.seconds,
    )
    return result
