"""What would explain that checks of a calibration failed: by the frames, the fit, and the checks."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from irlos_pipe.conventions.units import cutoff_per_px
from irlos_pipe.effects import Conditions
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.causes import (
    ENOUGH,
    NAN,
    Asked,
    Cause,
    causes_of_misfit,
    dark_left_in,
    improbable_diversity,
)
from irlos_pipe.frames.measured_noise import SIGNIFICANT
from irlos_pipe.frames.told import (
    BEYOND,
    GAIN,
    LAST_PER_PX,
    OVERFLOWED,
    READ_NOISE,
    SMALLEST_NM,
    cutoff_ratio,
)
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.calibrate.quality import ERROR, MISFIT
from irlos_pipe.stages.calibrate.results import CauseRow
from irlos_pipe.stages.calibrate.stage import Config
from irlos_pipe.stages.ingest.results import IngestResults, NoiseRow, RecordingRow

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
) -> list[CauseRow]:
    """Return the causes of the failed ones of `checks` and of those of the recordings, or the one `name`."""
    product = ctx.products["ingest"]
    places = f"ingest/{ctx.config.input}/{f'{name}/' * bool(name)}", f"{name}: " if name else ""
    failed = [one for one in product.checks if not one.passed and one.name.startswith(places[0])]
    own = (one for one in checks if not one.passed and one.name.startswith(places[1]))
    failed += [replace(one, name=one.name.removeprefix(places[1])) for one in own]
    if not failed:
        return []
    inputs = results_of(IngestResults, product).inputs
    rows = [row for row in inputs if row.input == ctx.config.input and name in ("", row.name)]
    found = [cause for row in rows for cause in _of_frames(row)]
    sure = any(one.name == "overflow" for one in found)
    if result.fit is not None and conditions is not None and not sure:
        asked = _asked(ctx, conditions, result)
        names, diversity_nm = {one.name for one in failed}, conditions.diversity_nm.values()
        other = improbable_diversity(dict(zip(result.nolls, result.zernike_nm.tolist(), strict=True)), asked)
        if names & {MISFIT, ERROR} and result.chi2_nu > result.nominal.most:
            found += [*causes_of_misfit(result.fit[0], result.fit[1].values[:1], asked), *other]
        elif MISFIT in names:
            found += dark_left_in(result.fit[0], result.fit[1].values[:1])
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
    says = f"{name}: " if name else ""
    return [CauseRow.filled_from(one, says=f"{says}{one.says}") for one in found if first[one.name] is one]


def _asked(ctx: StageContext[Config], conditions: Conditions, result: Calibration) -> Asked:
    settings = conditions.settings
    expected = cutoff_per_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    good = np.isfinite(result.sigma_image_e)
    cutoff = cutoff_ratio(result.mean_image_e, good, expected)
    if np.isnan(cutoff):  # the declared pupil may be much too large: does detail end far below it?
        cutoff = cutoff_ratio(result.mean_image_e, good, expected, LAST_PER_PX)
        cutoff = cutoff if cutoff * expected * BEYOND < LAST_PER_PX else NAN
    return Asked(
        conditions,
        result.nominal.value,
        cutoff,
        ctx.instrument.name,
        {one: load_instrument(one).pupil for one in SHIPPED if one != ctx.instrument.name},
    )


def _of_frames(row: RecordingRow) -> Iterator[Cause]:
    """What the frames of a recording contradict beyond doubt: integers, and the constants of the detector."""
    overflowed = [text for text in row.doubts if OVERFLOWED in text]
    if overflowed:
        yield Cause("overflow", overflowed[0], figure="cal-images")
        return
    gain, noise = (row.noise.get(key, NoiseRow()) for key in (GAIN, READ_NOISE))
    if _apart(gain) and not 1 / WRONG < gain.used / gain.measured < WRONG:
        yield _constant("gain", "a gain", gain, "e-/ADU", GAIN)
    elif _apart(noise) and noise.used > WRONG * noise.measured:  # dark and sky add to the read noise
        yield _constant("read_noise", "a read noise", noise, "e-", READ_NOISE)


def _apart(row: NoiseRow) -> bool:
    return row.measured > 0 and abs(row.measured - row.used) > SIGNIFICANT * row.error


def _constant(name: str, words: str, row: NoiseRow, unit: str, key: str) -> Cause:
    says = (
        f"{words} of {row.measured:.3g} ± {row.error:.2g} {unit} instead of {row.used:.3g} {unit} would "
        f"explain how the frames scatter: {key}"
    )
    return Cause(name, says, NAN, row.measured, row.error, row.used, unit, key, "cal-time")
