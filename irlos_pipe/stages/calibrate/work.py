"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS, HIGHEST_REPORTED_NOLL, TIP_TILT
from irlos_pipe.effects import Conditions, everyday
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.companion import Ghost
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.public_values import mean_of, measured, rows_of
from irlos_pipe.effects.wavefront import FilterNcpa
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_errors import errors_of_mean
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions, NcpaPrior
from irlos_pipe.estimate.lenslets import NOLLS, identified, modes_of_centroids_nm
from irlos_pipe.estimate.setups import Setup, calibrate_setups, is_common
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.numerics.parallel import process_map
from irlos_pipe.optics.image_quality import correlations
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.product.product import Quantity, declared
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.quality import MISFIT, causes_of, checks_of, motion_line, unexcused
from irlos_pipe.stages.calibrate.stage import (
    ARRAYS,
    CUBES,
    CalibrateResults,
    Config,
    CubeRow,
    Estimate,
    Lenslets,
    Tail,
)
from irlos_pipe.stages.ingest.stage import recordings_from_product
from irlos_pipe.stages.model.effects import (
    colour_warning,
    conditions_of,
    good_pixels,
    image_effects,
    model_effects,
    pooled_frames,
    psf_settings,
    seeing_arcsec,
    shown,
    with_colour,
)
from irlos_pipe.stages.model.groups import by_setup, of_several_setups, require_calibration, require_joint
from irlos_pipe.stages.model.untested import CUBES_IN_SHORT, FAINT_VANES, untested_by_cubes


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate with the chosen method, and with the methods to compare."""
    recordings = [r.accepted() for r in recordings_from_product(ctx.products["ingest"], ctx.config.input)]
    require_calibration(recordings)
    return _each(ctx, recordings) if ctx.config.each else _together(ctx, recordings)


def _together(ctx: StageContext[Config], recordings: list[Recording]) -> StageOutput:
    """One estimate from all recordings."""
    used = [r for r in recordings if r.frames]
    if not used:
        raise InputDataError(_no_frame(recordings[0]))
    if of_several_setups(used):
        if ctx.config.compare:
            ctx.log.warning("calibrate.compare is left out: methods are compared on frames of one set-up")
        output = _joint_output(ctx, _joint_fit(ctx, used), [], used[0].acquisition)
        if all(check.passed for check in output.checks):
            return output
        return replace(output, results=output.results.model_copy(update={"no_causes": SETUPS_NOT_TESTED}))
    first = recordings[0].acquisition
    options = ctx.config.options(ctx.instrument.facility.ncpa_law)
    cube, conditions = cube_input(ctx, recordings, options)

    def compared(method: str) -> tuple[Calibration, list[str]]:
        """The result of another method, as far as it is compared, and lines for the log."""
        lines = list[str]()
        of_method = ctx.config.options(ctx.instrument.facility.ncpa_law, method)
        return replace(_calibrate(ctx, recordings, of_method, note=lines.append), fit=None), lines

    adopted = list[Calibration]()
    others = process_map(
        compared,
        [method for method in ctx.config.compare if method != ctx.config.method],
        meanwhile=lambda: adopted.append(_calibrate(ctx, recordings, options, (cube, conditions))),
    )
    for line in (line for _, lines in others for line in lines):
        ctx.log.info(line)
    joint = _joint_output(ctx, adopted[0], [result for result, _ in others], first)
    output = _with_causes(ctx, joint, conditions, adopted[0])
    if first.lenslets == 1:
        return output
    row, lines = _lenslets(ctx, adopted[0], cube)
    results = output.results.model_copy(update={"lenslets": row})
    return replace(output, results=results, summary=[*output.summary, *lines])


def _joint_fit(ctx: StageContext[Config], recordings: list[Recording]) -> Calibration:
    """One wavefront, and what of it belongs to wavelength, filter or lens, from several set-ups."""
    groups, options = by_setup(recordings), ctx.config.options(ctx.instrument.facility.ncpa_law)
    require_joint(ctx.model, groups, options.method, adjust=ctx.config.adjust is True)
    result = calibrate_setups(setups_of(ctx, groups, options), options, device=ctx.device, note=ctx.log.info)
    ctx.log.info("%d set-ups together: chi2/nu %.2f, %.1f s", len(groups), result.chi2_nu, result.seconds)
    return result


def _each(ctx: StageContext[Config], recordings: list[Recording]) -> StageOutput:
    """An estimate from every recording; keys and arrays of a joint estimate hold the mean over the cubes.

    Those of every cube stand in ``cubes``, its arrays under ``cubes/<name>/``.
    """
    usable = [r for r in recordings if r.frames]
    failures = [_no_frame(r) for r in recordings if not r.frames]
    if not usable:
        raise InputDataError(failures[0])
    options = ctx.config.options(ctx.instrument.facility.ncpa_law)
    cubes = [
        (one, _joint_fit(ctx, [one]) if of_several_setups([one]) else _calibrate(ctx, [one], options))
        for one in usable
    ]
    mean = _mean_calibration([result for _, result in cubes])
    arrays = _arrays(mean, note="mean over the cubes", only=MEAN)
    for one, result in cubes:
        arrays |= _arrays(result, f"{CUBES}/{one.name}/")
    why = [_undetermined(result) for _, result in cubes]
    taken = [one.acquisition for one, _ in cubes]
    results = CalibrateResults(
        **_estimate(mean),
        seeing_arcsec=float(np.mean([seeing_arcsec(ctx.instrument, one) for one in taken])),
        wavelength_nm=float(np.mean([one.wavelength_nm for one in taken])),
        twin=None,
        compare=[],
        cubes=[
            CubeRow(
                name=one.name, derotator_angle_deg=one.acquisition.derotator_angle_deg, **_estimate(result)
            )
            for one, result in cubes
        ],
        untested=untested_by_cubes(taken[0].diversity, next(filter(None, why), "")),
    )
    checks = {one.name: checks_of(ctx.config, result, f"{one.name}: ") for one, result in cubes}
    failed = [cube for cube in cubes if not all(check.passed for check in checks[cube[0].name])]
    lines, every = _mean_summary(mean, cubes), [check for of_one in checks.values() for check in of_one]
    output = StageOutput(arrays, results, every, summary=lines, failures=failures)
    own, worst = max(failed or cubes, key=lambda cube: cube[1].chi2_nu / cube[1].nominal.value)
    conditions = cube_input(ctx, [own], worst.options)[1] if worst.fit else None
    return _with_causes(ctx, output, conditions, worst, own.name)


def _no_frame(recording: Recording) -> str:
    return f"{recording.name}: no used frame is left to calibrate with"


def _calibrate(
    ctx: StageContext[Config],
    recordings: list[Recording],
    options: CalibrationOptions,
    cube: tuple[Setup, Conditions] | None = None,
    note: Callable[[str], None] | None = None,
) -> Calibration:
    """One method on all frames of the recordings, on their `cube` where that is made already.

    Without a `note` that takes lines, they go to the log, and a progress bar is shown.
    """
    one, conditions = cube or cube_input(ctx, recordings, options)
    quiet: dict[str, Any] = {"disable": True} if note else {}
    note, single = note or ctx.log.info, METHODS[options.method].fits == "every frame"
    total = len(one.frames.images_e) if single else 1
    with ctx.progress(total=total, desc=f"calibrate {options.method}", **quiet) as bar:
        context: dict[str, Any] = {"device": ctx.device, "report": bar.update, "note": note}
        if ctx.config.adjust and METHODS[options.method].open:
            context["adjustable"] = [*everyday([conditions], one.own), Ghost.under(conditions)]
            context["adjust_always"] = ctx.config.adjust is True
        result = calibrate(one.frames, one.settings, options, one.own, **context)
    rms_nm = wfe_nm(result.nolls, result.zernike_nm)
    fitted = f"{rms_nm:.1f} nm RMS, chi2/nu {result.chi2_nu:.2f}, {result.seconds:.1f} s"
    note(f"{recordings[0].name}, {options.method}: {fitted}")
    return result


def _with_causes(
    ctx: StageContext[Config],
    output: StageOutput,
    conditions: Conditions | None,
    result: Calibration,
    name: str = "",
) -> StageOutput:
    """The output with what would explain the checks that failed, of `each` those of the recording `name`."""
    checks, passed = output.checks, all(check.passed for check in output.checks)
    causes = causes_of(ctx, conditions, result, checks, name)
    if passed and not causes:
        return output
    why = causes[0].says if causes else NOTHING_EXPLAINS if result.fit else NOT_TESTED
    lines = [f"Cause {place}         {one.says}" for place, one in enumerate(causes, start=1)]
    for line in lines:
        ctx.log.warning(line)
    misfit = f"{name}: {MISFIT}" if name else MISFIT
    if passed:  # a wrong fact explains what the errors were to count
        checks = [unexcused(one, result) if one.name == misfit else one for one in checks]
    checks = [
        replace(one, message=f"{one.message}: {why}")
        if one.name == misfit and not one.passed and one.value > (one.low or 0.0)
        else one
        for one in checks
    ]
    results = output.results.model_copy(update={"causes": causes, "no_causes": "" if causes else why})
    return replace(output, results=results, checks=checks, summary=[*output.summary, *lines])


# -- frames and model of a set-up, or of several ----------------------------------------------------


def cube_input(
    ctx: StageContext, recordings: Sequence[Recording], options: CalibrationOptions
) -> tuple[Setup, Conditions]:
    """Return all frames of `recordings` of one set-up, with the model of the first, and its conditions.

    The `options` state its modes, `ctx` has the instrument and the section `model` of the recipe. Bad pixels
    that the model lists are masked.
    """
    first, highest_noll = recordings[0], options.last_noll
    conditions = conditions_of(ctx.instrument, ctx.model, first, highest_noll)
    effects = shown(model_effects(ctx.instrument, ctx.model, first, highest_noll), [conditions])
    effects = with_colour(effects, ctx.model, conditions)
    if warning := colour_warning(effects, recordings):
        ctx.log.warning(warning)
    introduced_nm = {DEFOCUS: float(first.introduced_defocus_nm[0])}
    settings = psf_settings(ctx.instrument, ctx.model, first, introduced_nm=introduced_nm)
    steady = METHODS[options.method].effects
    frames = pooled_frames(recordings, good_pixels(effects, first.window), settings, steady=steady)
    cube = Setup(frames, settings, own=image_effects(effects), names=tuple(one.name for one in recordings))
    return cube, replace(conditions, settings=settings)


def setups_of(
    ctx: StageContext, groups: Sequence[Sequence[Recording]], options: CalibrationOptions
) -> list[Setup]:
    """Return what `calibrate_setups` needs with `options` of `groups`, see `by_setup`; `ctx` as above."""
    highest_noll = options.last_noll
    reference_nm = groups[0][0].acquisition.wavelength_nm
    conditions = [
        conditions_of(
            ctx.instrument,
            ctx.model,
            one,
            highest_noll,
            introduced_nm={DEFOCUS: float(one.introduced_defocus_nm[0])} if one.frames else {},
            ncpa_wavelength_nm=reference_nm,
        )
        for one, *_ in groups
    ]
    first = model_effects(
        ctx.instrument, ctx.model, groups[0][0], highest_noll, ncpa_wavelength_nm=reference_nm
    )
    # Recordings of known focus show the focus of a filter or lens.
    common = [
        effect.with_focus() if isinstance(effect, FilterNcpa) else effect
        for effect in image_effects(shown(first, conditions))
        if is_common(effect)
    ]
    found = []
    for group, under in zip(groups, conditions, strict=True):
        listed = model_effects(ctx.instrument, ctx.model, group[0], highest_noll)
        own = [e for e in image_effects(with_colour(listed, ctx.model, under)) if not is_common(e)]
        if warning := colour_warning(own, group):
            ctx.log.warning(warning)
        frames = pooled_frames(group, good_pixels(listed, group[0].window), under.settings)
        shared = [effect.seen_in(under, conditions[0]) for effect in common]
        found.append(Setup(frames, under.settings, shared, own, tuple(one.name for one in group)))
    return found


# -- what is reported --------------------------------------------------------------------------------

NOTHING_EXPLAINS = "nothing by itself explains it; irlos run diagnose tries more"
NOT_TESTED = "causes are computed for the mean image of one star only; irlos run diagnose tries more"
ADJUSTED = "  facts of the instrument, not quite as declared, follow the images (calibrate.adjust)"
SETUPS_NOT_TESTED = "causes are not computed for several set-ups together; calibrate.each looks for them"
INACCURATE = 0.1  # part of introduced defoci; stages are better calibrated than that
LABEL_WIDTH = 24  # letters before the numbers in lines for the terminal; the longest effect has 22
HIGHER = DEFOCUS  # first mode of the wavefront without tip and tilt
MEAN = ("noll", "zernike_nm", "modes_nm", "covariance_nm2", "effects")  # arrays of the mean over cubes


def _joint_output(
    ctx: StageContext[Config], result: Calibration, others: Sequence[Calibration], acquisition: Acquisition
) -> StageOutput:
    """One estimate, together with those of other methods; `acquisition` is that of the first recording."""
    results = CalibrateResults(
        **_estimate(result),
        effects_sigma=result.effects_sigma,
        seeing_arcsec=seeing_arcsec(ctx.instrument, acquisition),
        wavelength_nm=acquisition.wavelength_nm,
        twin=result.twin,
        untested=untested_by_cubes(
            acquisition.diversity, _undetermined(result), [one.introduced_nm for one in result.setups]
        ),
        compare=[Estimate(**_estimate(other)) for other in others],
        setups=list(result.setups),
        adjusted=result.adjusted,
        introduced_accuracy=result.introduced_accuracy,
    )
    if result.introduced_accuracy > INACCURATE:
        ctx.log.warning(
            f"the planes want introduced defoci that are {result.introduced_accuracy:.0%} off the declared "
            "ones: check the calibration of what introduces them; errors of the NCPAs allow for it"
        )
    summary = _summary(result, others)
    return StageOutput(_arrays(result), results, checks_of(ctx.config, result), summary=summary)


def _mean_calibration(results: Sequence[Calibration]) -> Calibration:
    """Return the plain mean of estimates from cubes, which count equally however bright they are.

    It has the modes and effects that all of them have, and the frames and fits of all.
    """
    first = min(results, key=lambda one: len(one.nolls))
    own = slice(len(first.nolls))
    common = [name for name in first.effects if all(name in one.effects for one in results)]

    def mean(name: str) -> np.ndarray:
        return np.mean([getattr(one, name)[own] for one in results], axis=0)

    return replace(
        first,
        zernike_nm=mean("zernike_nm"),
        fitted_modes_nm=mean("fitted_modes_nm"),
        covariance_nm2=errors_of_mean(
            np.array([one.zernike_nm[own] for one in results]),
            [one.covariance_nm2[own, own] for one in results],
        ),
        effects=mean_of([{name: one.effects[name] for name in common} for one in results]),
        effect_values={
            name: np.mean([one.effect_values[name] for one in results], axis=0) for name in common
        },
        frames_nm=np.concatenate([one.frames_nm[:, own] for one in results]),
        frame_status=[status for one in results for status in one.frame_status],
        chi2_nu=float(np.mean([one.chi2_nu for one in results])),
        nominal=replace(
            first.nominal,
            value=float(np.mean([one.nominal.value for one in results])),
            sigma=float(np.mean([one.nominal.sigma for one in results])),
        ),
        seconds=sum(one.seconds for one in results),
        twin=None,
        tail=None,
    )


def _undetermined(result: Calibration) -> str:
    """Return why a `result` does not determine whether the images are mirrored; empty where it does."""
    return "" if result.mirrored is not None and result.mirrored.tells else FAINT_VANES


def _reported(nolls: Sequence[int]) -> slice:
    """Return the positions of the reported modes among rising Noll indices `nolls`."""
    return slice(0, sum(noll <= HIGHEST_REPORTED_NOLL for noll in nolls))


def wfe_nm(
    nolls: Sequence[int], zernike_nm: np.ndarray, first: int = 2, last: int = HIGHEST_REPORTED_NOLL
) -> float:
    """Return the RMS [nm] of those of modes `nolls` from `first` to `last` with `zernike_nm`, (modes,).

    Of standard errors this is the total error to be expected.
    """
    own = (np.asarray(nolls) >= first) & (np.asarray(nolls) <= last)
    return float(np.sqrt(np.sum(zernike_nm[own] ** 2)))


def _by_noll(nolls: Sequence[int], values: np.ndarray) -> dict[int, float]:
    """Return the `values` of the reported modes by their index; `nolls` has that of every value."""
    own = _reported(nolls)
    return dict(zip(nolls[own], values[own].tolist(), strict=True))


def _estimate(result: Calibration) -> dict[str, Any]:
    """Return the keys of `Estimate`, and the effects."""
    return {
        "method": result.options.method,
        "zernike_nm": _by_noll(result.nolls, result.zernike_nm),
        "sigma_nm": _by_noll(result.nolls, result.sigma_nm),
        **{
            f"{name}_nm": wfe_nm(result.nolls, values, *modes)
            for part, modes in {"wfe": (), "higher": (HIGHER,), "tip_tilt": TIP_TILT}.items()
            for name, values in {part: result.zernike_nm, f"{part}_sigma": result.sigma_nm}.items()
        },
        "frames": len(result.frames_nm),
        "errors_from": result.errors_from,
        "seconds": round(result.seconds, 3),
        "chi2_nu": result.chi2_nu,
        "nominal_chi2_nu": result.nominal.value,
        "nominal_chi2_nu_sigma": result.nominal.sigma,
        "loss": result.options.loss,
        "optimiser": result.options.optimiser,
        "modes_estimated": len(result.nolls),
        "all_zernike_nm": dict(zip(result.nolls, result.zernike_nm.tolist(), strict=True)),
        "tail": _tail(result),
        "effects": result.effects,
        "status": {name: list(result.frame_status).count(name) for name in sorted(set(result.frame_status))},
    }


def _tail(result: Calibration) -> Tail | None:
    """The law of the modes beyond the closed basis, and their RMS."""
    if result.tail is None:
        return None
    beyond = np.asarray(result.nolls) >= result.tail.first_noll
    return Tail.filled_from(result.tail, wfe_nm=float(np.linalg.norm(result.zernike_nm[beyond])))


def _arrays(
    result: Calibration, below: str = "", note: str = "", only: Sequence[str] = ()
) -> dict[str, Quantity]:
    """The arrays of an estimate, in the group `below`; of those in a group or alone only the ones named."""
    own, left = _reported(result.nolls), result.left
    values: dict[str, Any] = {} if left is None else {"left_frequency": left.at, "left_power": left.value}
    values |= {} if result.left_nominal is None else {"left_nominal": result.left_nominal}
    values |= {
        "noll": result.nolls,
        "zernike_nm": (result.zernike_nm, result.sigma_nm),
        "modes_nm": result.fitted_modes_nm,
        "covariance_nm2": result.covariance_nm2,
        "correlation": correlations(result.covariance_nm2[own, own]),
        "frames_nm": result.frames_nm,
        "frame_status": np.array(result.frame_status, dtype=object),
        "iterations": result.iterations,
        "mean_image_e": (result.mean_image_e, result.sigma_image_e),
        "model_image_e": result.model_image_e,
        **{f"effects/{name}": parameters for name, parameters in result.effect_values.items()},
    }
    if result.setups:
        images, models, sigma = (
            np.array([getattr(one, name) for one in result.setups])
            for name in ("mean_e", "model_e", "sigma_e")
        )
        values |= {"setup_images_e": (images, sigma), "setup_models_e": models}
    wanted = {name: one for name, one in values.items() if not only or name.partition("/")[0] in only}
    return declared(ARRAYS, wanted, note, below=below)


def _effect_lines(effects: dict[str, dict], sigma: dict[str, dict] | None = None) -> list[str]:
    """Return one line per effect, with the errors `sigma` where there are any."""
    errors = sigma or {}
    return [
        f"  {name:{LABEL_WIDTH}s}"
        + ", ".join(f"{key} {value:.4g}" for key, value in rows_of(measured(values, errors.get(name, {}))))
        for name, values in effects.items()
    ]


def _ncpa_text(result: Calibration) -> str:
    """The wavefront, tip and tilt apart, which say where the star stood."""
    higher, tip_tilt = (
        f"{wfe_nm(result.nolls, result.zernike_nm, *modes):.1f} ± "
        f"{wfe_nm(result.nolls, result.sigma_nm, *modes):.1f} nm"
        for modes in ((HIGHER,), TIP_TILT)
    )
    last = result.nolls[_reported(result.nolls)][-1]
    return f"NCPA            {higher} RMS in Noll {HIGHER}–{last}, tip and tilt {tip_tilt}"


def _summary(result: Calibration, others: Sequence[Calibration]) -> list[str]:
    few = ["  errors from the noise model and the misfit: too few frames to show their scatter"]
    law = []
    if tail := _tail(result):
        law = [
            f"  {f'Noll {tail.first_noll}–{result.nolls[-1]}':{LABEL_WIDTH}s}{tail.wfe_nm:.1f} nm RMS, "
            f"law {tail.amplitude_nm:.2g} nm each, as order^{-tail.slope:.1f}"
        ]
    return [
        f"{_ncpa_text(result)} ({result.options.method}, {result.seconds:.1f} s, χ²/ν {result.chi2_nu:.2f}, "
        f"nominal {result.nominal.value:.2f})",
        *(few if result.errors_from != "frames" else []),
        *([] if result.motion is None else [f"  {motion_line(result.motion)}"]),
        *([ADJUSTED] if result.adjusted else []),
        *law,
        *_effect_lines(result.effects, result.effects_sigma),
        *(
            f"  beside: {wfe_nm(other.nolls, other.zernike_nm, HIGHER):.1f} nm RMS ({other.options.method}, "
            f"{other.seconds:.1f} s, χ²/ν {other.chi2_nu:.2f})"
            for other in others
        ),
        CUBES_IN_SHORT,
    ]


def _mean_summary(mean: Calibration, cubes: Sequence[tuple[Recording, Calibration]]) -> list[str]:
    return [
        f"{_ncpa_text(mean)}: mean of {len(cubes)} {'cube' if len(cubes) == 1 else 'cubes'} "
        f"({mean.options.method})",
        *_effect_lines(mean.effects),
        *(
            f"  {one.name}: {wfe_nm(result.nolls, result.zernike_nm, HIGHER):.1f} nm RMS, "
            f"derotator {one.acquisition.derotator_angle_deg:g}°, χ²/ν {result.chi2_nu:.2f}"
            for one, result in cubes
        ),
        CUBES_IN_SHORT,
    ]


# -- what the images of a 2x2 mode determine, and their centroids ------------------------------------

TRIED_NOLLS = tuple(range(2, 46))


def _lenslets(
    ctx: StageContext[Config], result: Calibration, cube: Setup
) -> tuple[Lenslets, tuple[str, ...]]:
    """Return what the images of `cube` determine in addition to the prior, and what their centroids say.

    Also as lines for the terminal.
    """
    law = ctx.instrument.facility.ncpa_law
    scale = ctx.config.prior_scale or Config().prior_scale or 1.0
    known = dict(zip(result.nolls, result.fitted_modes_nm.tolist(), strict=True))
    tried = _identified(ctx, result, cube, known, TRIED_NOLLS, NcpaPrior(law, scale))
    own = _identified(ctx, result, cube, known, result.nolls, NcpaPrior(law, scale))
    per_frame = modes_of_centroids_nm(
        cube.frames.images_e.numpy(),
        cube.settings.geometry,
        cube.settings.pixel_scale_mas,
        float(np.sqrt(cube.frames.noise.floor_e2)),
    )
    count = len(per_frame)
    sigma = per_frame.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.full(len(NOLLS), np.nan)
    row = Lenslets(
        modes_tried=len(TRIED_NOLLS),
        combinations=tried.combinations,
        information=tried.information.tolist(),
        determined=list(tried.determined()),
        left=dict(zip(TRIED_NOLLS, tried.left.tolist(), strict=True)),
        bound_nm=dict(zip(result.nolls, own.bound_nm.tolist(), strict=True)),
        centroids_nm=dict(zip(NOLLS, per_frame.mean(axis=0).tolist(), strict=True)),
        centroids_sigma_nm=dict(zip(NOLLS, sigma.tolist(), strict=True)),
    )
    return row, (
        f"Lenslets        by their noise the four images determine {row.combinations} of {row.modes_tried} "
        f"combinations of Noll 2–{TRIED_NOLLS[-1]}, {len(row.determined)} modes to half of their prior",
        "  speckles, and places of the images that nobody knows, leave fewer: docs/two_by_two.md",
        f"  defocus from centroids {row.centroids_nm[4]:+.1f} ± {row.centroids_sigma_nm[4]:.1f} nm, "
        f"Cramér–Rao bound of the fit {row.bound_nm.get(4, np.nan):.1f} nm",
    )


def _identified(ctx, result: Calibration, cube: Setup, known: dict, nolls: tuple, prior: NcpaPrior):
    psf = light_path(cube.settings, nolls, device=ctx.device, dtype=torch.float64)
    effects = [effect for effect in cube.own if effect.plane in ("otf", "sampling")]
    model = ImageModel(psf, effects)
    labels = dict(zip(labels_of(cube.own), cube.own, strict=True))
    ordered = [label for one in model.effects.effects for label, e in labels.items() if e is one]
    values = [result.effect_values[label] for label in ordered]
    start = torch.as_tensor(np.concatenate([*values, np.empty(0)]))
    return identified(model, known, start, cube.frames, prior.sigma_nm(nolls).numpy())
