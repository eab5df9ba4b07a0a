"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

from __future__ import annotations

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import (
    CalibrationOptions,
)
from irlos_pipe.estimate.methods import scheme_of
from irlos_pipe.estimate.setups import calibrate_setups
from irlos_pipe.frames.recording import Recording
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.config import Config
from irlos_pipe.stages.calibrate.input import CubeInput, cube_input, require_calibration
from irlos_pipe.stages.calibrate.output import joint_output, wfe_nm
from irlos_pipe.stages.calibrate.per_recording import Cube, each_output
from irlos_pipe.stages.calibrate.setups import by_setup, require_joint, setups_of
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.recording_settings import SETUP_KEYS, differences, seeing_arcsec


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
    options = ctx.config.options(ctx.instrument.facility.ncpa_law)
    cube = cube_input(ctx, recordings, options)
    result = _calibrated(ctx, recordings[0].name, cube, options)
    others = [
        _calibrate(ctx, recordings, ctx.config.options(ctx.instrument.facility.ncpa_law, method))
        for method in ctx.config.compare
        if method != ctx.config.method
    ]
    first = recordings[0].acquisition
    seeing = seeing_arcsec(ctx.instrument, first)
    output = joint_output(ctx.config, result, others, seeing, first)
    if first.lenslets == 1:
        return output
    from irlos_pipe.stages.calibrate.lenslets import with_lenslets

    return with_lenslets(ctx, output, result, cube)


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
    return _calibrated(ctx, recordings[0].name, cube_input(ctx, recordings, options), options)


def _calibrated(
    ctx: StageContext[Config], name: str, cube: CubeInput, options: CalibrationOptions
) -> Calibration:
    """One method on a cube that begins with the recording `name`."""
    total = scheme_of(options).fits(cube.frames)
    with ctx.progress(total=total, desc=f"calibrate {options.method}") as bar:
        result = calibrate(
            cube.frames, cube.settings, options, cube.effects, device=ctx.device, report=bar.update
        )
    ctx.log.info(
        "%s, %s: %.1f nm RMS, chi2/nu %.2f, %.1f s",
        name,
        options.method,
        wfe_nm(result.nolls, result.zernike_nm),
        result.chi2_nu,
        result.seconds,
    )
    return result
