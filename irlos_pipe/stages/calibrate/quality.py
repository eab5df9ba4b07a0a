"""Quality control of stage `calibrate`: what a cube shows against what was declared for it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS, HIGHEST_REPORTED_NOLL
from irlos_pipe.conventions.units import cutoff_per_px
from irlos_pipe.effects import CATALOGUE, Conditions
from irlos_pipe.effects.base import kind_of
from irlos_pipe.estimate.calibration import Calibration, facts_of
from irlos_pipe.estimate.calibration_options import Cause, OneSetup
from irlos_pipe.estimate.causes import (
    ENOUGH,
    EXPLAINED,
    Asked,
    causes_of_misfit,
    dark_left_in,
    improbable_diversity,
)
from irlos_pipe.estimate.cube import CLEAR, LEAST_FRAMES, Motion
from irlos_pipe.estimate.image_fit import Fit, ImageFit
from irlos_pipe.estimate.score_test import Mirrored
from irlos_pipe.frames.told import (
    BEYOND,
    GAIN,
    LAST_PER_PX,
    OVERFLOWED,
    READ_NOISE,
    SIGNIFICANT,
    SMALLEST_NM,
    Constant,
    cutoff_ratio,
)
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.calibrate.stage import Config, Limits
from irlos_pipe.stages.ingest.stage import IngestResults, RecordingRow

SPECKLED = {name for name, kind in CATALOGUE.items() if kind.speckles}
# Effects that make frames scatter by more than noise.
UNSTEADY = SPECKLED | {name for name, kind in CATALOGUE.items() if kind.blurs == "motion"}
LOWEST_NOISE_RATIO = 0.5  # cross-talk of detectors lowers the scatter to 0.7 of the noise at most
NEARER = 0.5  # part of the distance of neighbouring planes
MISFIT, ERROR = "chi2 of the mean image", "error of the wavefront"
COUNTED = ": the model lacks something, which the errors count"


def checks_of(limits: Limits, result: Calibration, prefix: str = "") -> list[Check]:
    """Return the checks of a `result` against the `limits`; `prefix` begins their names."""
    converged = result.frame_status.count("converged") / len(result.frame_status)
    message, size = f"{converged:.0%} of the fits converged", result.window_resolutions
    window = Check("window", size, "", limits.min_window, None, f"the window is {size:.1f} λ/D wide")
    checks = [
        Check("converged fits", converged, "", limits.min_converged, None, message),
        _misfit(limits, result),
        window.because("too much of the light lies outside"),
    ]
    if error_is_known(result) or math.isfinite(result.introduced_accuracy):
        checks.append(_error(limits, result))
    if math.isfinite(result.noise_ratio):
        checks.append(_noise(result))
    checks += frame_checks(result.kurtosis, result.motion, result.mean_image_e.shape, limits.max_motion)
    alone = len(result.frames_nm) == 1 and not UNSTEADY.isdisjoint(map(kind_of, result.effects))
    if result.errors_from == "few_frames" or alone:
        checks.append(_frames(limits, result))
    if result.twin is not None:
        checks.append(_twin(result))
    if result.adjusted and result.fit is not None:
        checks.append(_facts(result.fit))
    if len({one.introduced_nm for one in result.setups}) > 1:
        checks.append(_planes(result.setups))
    if result.mirrored is not None and result.mirrored.tells:
        checks.append(_orientation(result.mirrored))
    return [replace(one, name=f"{prefix}{one.name}") for one in checks]


def error_is_known(result: Calibration) -> bool:
    """Whether errors are those of a fit behind an AO system whose frames show them."""
    behind_ao = not SPECKLED.isdisjoint(map(kind_of, result.effects))
    return result.fit is not None and result.errors_from == "frames" and behind_ao


def _error(limits: Limits, result: Calibration) -> Check:
    """The quoted error of what is delivered against what is of use."""
    delivered = (np.asarray(result.nolls) >= DEFOCUS) & (np.asarray(result.nolls) <= HIGHEST_REPORTED_NOLL)
    error_nm = float(np.linalg.norm(result.sigma_nm[delivered]))
    message = f"Noll {DEFOCUS}–{HIGHEST_REPORTED_NOLL} are known to {error_nm:.1f} nm RMS"
    check = Check(ERROR, error_nm, "nm", None, limits.max_error_nm, message)
    return check.because("too large to be of use")


def _misfit(limits: Limits, result: Calibration) -> Check:
    """χ²/ν against what the frames let expect, from both sides."""
    nominal = result.nominal
    high = nominal.most
    if error_is_known(result):
        high = nominal.most_behind_ao
    low = nominal.least if len(result.frames_nm) >= LEAST_FRAMES else 0.0
    if limits.max_chi2_nu is not None:
        high, low = limits.max_chi2_nu, 0.0
    why = ""
    if result.chi2_nu < low:
        why = ": neighbouring pixels share their noise, or frames are repeated"
    elif nominal.most < result.chi2_nu <= high and limits.max_chi2_nu is None:
        why = COUNTED
    message = (
        f"χ²/ν {result.chi2_nu:.2f}, nominal for these frames {nominal.value:.2f} ± {nominal.sigma:.2f}{why}"
    )
    return Check(MISFIT, result.chi2_nu, "", low, high, message)


def unexcused(check: Check, result: Calibration) -> Check:
    """Return the `check` of χ²/ν of a `result` without the allowance for another AO residual."""
    high = result.chi2_nu - result.nominal.excess(result.chi2_nu)
    return replace(check, high=high, message=check.message.removesuffix(COUNTED))


def _facts(fit: Fit) -> Check:
    """Facts of the instrument that were adjusted, against what any instrument has."""
    facts = facts_of(fit)
    odd = [fact.phrase(fact.shown(values)) for fact, values in facts if not fact.ordinary(values)]
    usual = f"{len(facts)} facts of the instrument follow the images and are off by no more than usual"
    message = "; ".join(odd) or usual
    return Check("facts", float(len(odd)), "", None, 0.0, message).because("not as declared")


def _noise(result: Calibration) -> Check:
    """Declared noise against the scatter of the frames, which nothing lowers much."""
    ratio = result.noise_ratio
    message = f"the frames scatter by {ratio:.2f} times the variance that the declared detector and star give"
    check = Check("noise as told", ratio, "", LOWEST_NOISE_RATIO, None, message)
    return check.because("e_per_adu is too small, or the read noise too large")


def frame_checks(
    kurtosis: float,
    motion: Motion | None,
    window: tuple[int, ...],
    max_motion: float = Limits.model_fields["max_motion"].default,
) -> list[Check]:
    """Return the checks of frames that are averaged: of one star, pointing and wavefront, and its motion.

    `kurtosis` of the frames (`estimate.cube`) is NaN where it means nothing, `motion` None without
    any. Of the `window`, rows and columns, the star may move over `max_motion` times the smaller side.
    """
    found = []
    if math.isfinite(kurtosis):  # frames of two kinds scatter, which excuses any misfit
        message = f"the frames have a kurtosis of {kurtosis:.2f} where they differ most"
        check = Check("frames of one kind", kurtosis, "", 1 + CLEAR, None, message)
        found.append(check.because("they are of two kinds, as of two stars"))
    if motion is not None:
        part = motion.largest_px / min(window)
        message = f"{motion_line(motion)}, by {part:.2f} of the window"
        check = Check("motion of the star", part, "", None, max_motion, message)
        found.append(check.because("too much of the light leaves the window"))
    return found


def motion_line(motion: Motion) -> str:
    """Return how the star moves, and what was done about it."""
    return f"the star {motion.course}, by {motion.largest_px:.1f} px in all; the frames are recentred"


def _frames(limits: Limits, result: Calibration) -> Check:
    count = len(result.frames_nm)
    scatter = "which scatter by more than noise" if count > 1 else "whose scatter beyond noise is not known"
    message = f"{count} frame{'s' * (count != 1)}, {scatter}"
    check = Check("frames", float(count), "", float(limits.min_frames), None, message)
    return check.because("too few to average the AO residual")


def _orientation(found: Mirrored) -> Check:
    """The pupil of the profile against the mirrored one."""
    message = (
        f"the image shows {found.amplitude:.2f} ± {found.sigma:.2f} of the mirrored pupil; 0 is the pupil as "
        "declared, 1 the mirrored one"
    )
    check = Check("orientation", found.amplitude, "", None, found.limit, message)
    return check.because("the images are mirrored, or the pupil of the profile is")


def _planes(planes: Sequence[OneSetup]) -> Check:
    """Whether neighbouring planes are as far apart as was declared, so that none is in its own twin."""
    ordered = sorted(planes, key=lambda one: one.introduced_nm)
    steps_nm = np.diff([one.introduced_nm for one in ordered])
    parts = np.abs(np.diff([one.focus_nm for one in ordered])) / np.where(steps_nm > 0, steps_nm, np.inf)
    at = int(parts.argmax())
    plane = max(ordered[at : at + 2], key=lambda one: abs(one.focus_nm))
    message = (
        f"the plane declared at {plane.introduced_nm:+.0f} nm by itself wants {plane.focus_nm:+.1f} ± "
        f"{plane.focus_sigma_nm:.1f} nm more; its distance to a neighbour is {parts[at]:.0%} off"
    )
    check = Check("planes", float(parts[at]), "", None, NEARER, message)
    return check.because("its declared defocus is wrong, or its sign")


def _twin(result: Calibration) -> Check:
    """The sign of the even modes, which only the diversity and the size of the NCPAs determine."""
    twin = result.twin
    assert twin is not None
    verdict = {
        "solution": "the sign of the even modes is known, if that of the diversity is",
        "twin": "the solution with the other sign of the even modes is the likelier one",
        "undecided": "the sign of the even modes is not known: too little diversity in even modes",
    }[twin.preferred]
    message = (
        f"{verdict} (evidence {twin.evidence:.1f}, {twin.rms_nm:.0f} against {twin.twin_rms_nm:.0f} nm RMS)"
    )
    return Check("twin solution", float(twin.preferred == "solution"), "", 1.0, None, message)


# -- what would explain that checks failed: by the frames, the fit, and the checks -----------------

SHIPPED = ("irlos", "bench", "pharo", "nirc2_narrow")  # profiles whose pupils are tried
WRONG = 2.0  # ratio of a declared constant to the measured one from which it is a cause
# Checks that name their own cause: name of the cause, and figure of the report to look at.
PLAIN = {
    "frames of one kind": ("mixed_frames", "cal-time"),
    "frames": ("frames", "cal-time"),
    "motion of the star": ("motion", "cal-images"),
    "window": ("window", "cal-images"),
    "bad_pixels": ("bad_pixels", "cal-images"),
    "saturated": ("saturation", "cal-images"),
}
BEFORE = ("overflow", "gain", "frames", "mixed_frames")  # what explains any misfit


def causes_of(
    ctx: StageContext[Config],
    conditions: Conditions | None,
    result: Calibration,
    checks: Sequence[Check],
    name: str = "",
) -> list[Cause]:
    """Return the causes of the failed ones of `checks` and of those of the recordings, or the one `name`.

    Where none failed, they are wrong facts, which fail the check of χ²/ν.
    """
    product = ctx.products["ingest"]
    places = f"ingest/{ctx.config.input}/{f'{name}/' * bool(name)}", f"{name}: " if name else ""
    failed = [one for one in product.checks if not one.passed and one.name.startswith(places[0])]
    own = (one for one in checks if not one.passed and one.name.startswith(places[1]))
    failed += [replace(one, name=one.name.removeprefix(places[1])) for one in own]
    if not failed:
        return _of_name(_wrong_facts(ctx, conditions, result), name)
    inputs = results_of(IngestResults, product).inputs
    rows = [row for row in inputs if row.input == ctx.config.input and name in ("", row.name)]
    found = [cause for row in rows for cause in _of_frames(row)]
    sure = any(one.name == "overflow" for one in found)
    if result.fit is not None and conditions is not None and not sure:
        problem, x, asked = _asked(ctx, conditions, result)
        names, diversity_nm = {one.name for one in failed}, conditions.diversity_nm.values()
        modes_nm = dict(zip(result.nolls, result.zernike_nm.tolist(), strict=True))
        other = improbable_diversity(modes_nm, conditions)
        if names & {MISFIT, ERROR} and result.chi2_nu > result.nominal.most:
            found += [*causes_of_misfit(problem, x, asked), *other]
        elif MISFIT in names:
            found += dark_left_in(problem, x)
        elif "twin solution" in names or any(0 < abs(nm) < SMALLEST_NM for nm in diversity_nm):
            found += other
    plain = [(PLAIN.get(one.name.rpartition("/")[2]), one.message) for one in failed]
    said = [Cause(kind[0], message, figure=kind[1]) for kind, message in plain if kind]
    low = result.chi2_nu < result.nominal.value
    dark = any(one.name == "background" and (low or one.explains >= ENOUGH) for one in found)
    bent = ("gain", "read_noise") if dark else ()  # a dark is no light that scatters
    before = [one for one in BEFORE if one not in bent]
    found = sorted([*found, *said], key=lambda one: 2 * (one.name in bent) or one.name not in before)
    first = {one.name: one for one in reversed(found)}  # of each name the likeliest
    return _of_name([one for one in found if first[one.name] is one], name)


def _of_name(found: Sequence[Cause], name: str) -> list[Cause]:
    says = f"{name}: " if name else ""
    return [replace(one, says=f"{says}{one.says}") for one in found]


def _wrong_facts(
    ctx: StageContext[Config], conditions: Conditions | None, result: Calibration
) -> list[Cause]:
    """Facts that explain most of a misfit that an AO residual of another shape would excuse.

    Modes imitate a wrong scale of the pixels until little is left, and are as wrong.
    """
    excused = error_is_known(result) and ctx.config.max_chi2_nu is None
    if conditions is None or not excused or result.adjusted or result.nominal.excess(result.chi2_nu) <= 0:
        return []
    facts = causes_of_misfit(*_asked(ctx, conditions, result), facts_only=True)
    return [one for one in facts if one.explains > EXPLAINED]


def _asked(
    ctx: StageContext[Config], conditions: Conditions, result: Calibration
) -> tuple[ImageFit, torch.Tensor, Asked]:
    """The fit of a result, its optimum, and what else is known to those who look for causes."""
    assert result.fit is not None
    problem, x, settings = result.fit.problem, result.fit.x, conditions.settings
    # of few frames that misfit, the fit has weights other than those of the reported χ²
    nominal = result.nominal.value * float(problem.reduced_chi2(x)[0]) / result.chi2_nu
    expected = cutoff_per_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    good = np.isfinite(result.sigma_image_e)
    cutoff = cutoff_ratio(result.mean_image_e, good, expected)
    if np.isnan(cutoff):  # the declared pupil may be much too large: does detail end far below it?
        cutoff = cutoff_ratio(result.mean_image_e, good, expected, LAST_PER_PX)
        cutoff = cutoff if cutoff * expected * BEYOND < LAST_PER_PX else math.nan
    pupils = {one: load_instrument(one).pupil for one in SHIPPED if one != ctx.instrument.name}
    return problem, x, Asked(conditions, nominal, cutoff, ctx.instrument.name, pupils)


def _of_frames(row: RecordingRow) -> Iterator[Cause]:
    """What the frames of a recording contradict beyond doubt: integers, and the constants of the detector."""
    overflowed = [text for text in row.doubts if OVERFLOWED in text]
    if overflowed:
        yield Cause("overflow", overflowed[0], figure="cal-images")
        return
    gain, noise = (row.noise.get(key, Constant()) for key in (GAIN, READ_NOISE))
    if _apart(gain) and not 1 / WRONG < gain.used / gain.measured < WRONG:
        yield _constant("gain", "a gain", gain, "e-/ADU", GAIN)
    elif _apart(noise) and noise.used > WRONG * noise.measured:  # dark and sky add to the read noise
        yield _constant("read_noise", "a read noise", noise, "e-", READ_NOISE)


def _apart(row: Constant) -> bool:
    return row.measured > 0 and abs(row.measured - row.used) > SIGNIFICANT * row.error


def _constant(name: str, words: str, row: Constant, unit: str, key: str) -> Cause:
    says = (
        f"{words} of {row.measured:.3g} ± {row.error:.2g} {unit} instead of {row.used:.3g} {unit} would "
        f"explain how the frames scatter: {key}"
    )
    return Cause(name, says, math.nan, row.measured, row.error, row.used, unit, key, "cal-time")
