"""Section on what the model lacked: verdict, names, images before and after, what is left, limits."""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure as Canvas

from irlos_pipe.diagnosis.records import Ranked
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.base import kind_of
from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.frames.recording import star_position
from irlos_pipe.report.content import Block, Figure, KeyNumber, Section, Stack, Table, Text, Width, shown
from irlos_pipe.report.drawing import (
    BEFORE_AFTER,
    BLUE,
    DIAGNOSED,
    GREEN,
    INK,
    ORANGE,
    energy_figure,
    otf_figure,
    power_figure,
    quantile_figure,
    star_profile,
    svg,
)
from irlos_pipe.report.images import (
    PERCENTILE,
    SIGNED,
    Ring,
    image_panel,
    image_views,
    in_sigma,
    percentile,
    pupil_map,
    residual_views,
    symmetric_scale,
)
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import (
    MISSING,
    MOST_ROWS,
    Row,
    in_one_line,
    is_known,
    number,
    parameter_rows,
    plural,
    rounded_by_error,
    shortened,
    sizes,
    with_error,
)
from irlos_pipe.stages.diagnose.stage import DiagnoseResults, StepRow

Diagnosis = StageData[DiagnoseResults]
Mark = Literal["good", "bad"]

# -- words -------------------------------------------------------------------------------------

VERDICTS = {"none": "nothing missing", "effect": "named", "unknown": "unknown"}
GRADES = {
    "none": "nothing significant is missing",
    "complete": "what was found explains all that was missing",
    "partial": "what was found is missing, and something else is missing as well",
    "resembles": "the best name explains much, but leaves a part of its own signal where it acts: it stands "
    "in for something that the catalogue lacks",
    "unknown": "something is missing that nothing in the catalogue explains",
}
OUTCOMES = {
    "named": "named",
    "nearest": "nearest, not named",
    "modelled": "in the model from the start",
    "adjusted": "adjusted beside the names",
    "fitted": "fitted, no better than a name",
    "scored": "not significant in what was left",
    "absorbed": "not to be seen in these data",
    "not tried": "not tried",
}
FINDINGS = {"common": "common to all", "differs": "differs", "open": "these data do not tell"}
CLEAR_Z = "3 is clear"
FOUND = (
    "Significance: of the fall of χ² by the fit. Explained: part of the excess over noise; where it acts: of "
    "its own signal, where that lies. z: by how much data that no fit has seen prefer the model with the "
    "name, 3 is clear. Petals and segments are given as differences from their mean."
)
HELD_OUT = "Mean of the held-out frames; of all frames where pixels were held out."
LEADING = (
    "The pattern by which frames differ most from one another, beyond what the fitted parameters change, in "
    "standard errors of a frame. Noise alone gives speckles of some tenths; a pattern says what moves."
)
REST = (
    "Measured − predicted after, on a scale of its own. The ring is as large as the strongest part and "
    "stands about it."
)
RAMP = (
    "Frames in order of time. Below: what the estimates miss of the commanded defocus, and of that with "
    "the errors of the stage that were found."
)
FINE = (
    "Structure finer than λ/D, which no light through the pupil can make: {} times what noise leaves "
    "there ({} σ). More comes from the pixels: flat, offsets, response."
)
NUMBERS_IN_NOTE = 3  # further numbers of an effect in the note of its tile
MANY = 100.0  # χ²/ν from which decimals say nothing
FEW = 3  # candidates below which a table shows all
LEADING_PERCENTILE = 99.5  # end of the scale of the leading mode: single pixels would swallow it
ADDED_PERCENTILE, NOTHING = 99.0, 1e-9  # end of the scale of what is added; size that stands for none


def diagnose_section(run: RunData) -> Section:
    of = run.of(DiagnoseResults)
    results = of.results
    ramp = of.blocks(_ramp)
    first = shown(verdict_table(results), _found(results), _candidates(results))
    blocks = [
        *([*ramp, Stack(first)] if ramp else first),
        *of.blocks(_residuals, _leading, _images, _rest, _added_wavefront, _added_amplitude),
        *of.blocks(
            _profile,
            partial(
                power_figure, name="dia-power", looks={f"_{key}": one for key, one in BEFORE_AFTER.items()}
            ),
            _quantiles,
            partial(otf_figure, name="dia-otf", looks=DIAGNOSED),
            lambda of: energy_figure(of, "dia-energy", DIAGNOSED, "Part of the light in the window."),
        ),
        *shown(sharing_tables(results), separation_table(results), _tried(results), _modes(results)),
        *shown(_limits(results)),
    ]
    frames, pixels = results.frames, results.held_out == "pixels"
    held_out = "some of their pixels" if pixels else frames.held_out
    lead = f"{plural(frames.training, 'frame')} fitted, {held_out} held out to judge the models."
    known = lead if pixels or frames.training else ""
    return Section(of.stage, f"What the {'ramp' if ramp else 'model'} lacks", known, blocks)


# -- verdict: tiles at the top of the page, and the same in short in the section ---------------


def verdict_mark(results: DiagnoseResults) -> Mark:
    """Return whether the model with what was named lacks nothing."""
    return "bad" if _lacking(results) else "good"


def verdict_numbers(results: DiagnoseResults) -> Iterator[KeyNumber]:
    """Yield the tiles of a diagnosis: names, gap, χ²/ν, what unseen data say, the runner-up, the rest."""
    if not results.verdict:
        return
    words = [VERDICTS.get(results.verdict, results.verdict)]
    words += [results.grade] if results.grade not in ("", results.verdict) else []
    yield KeyNumber("Diagnosis", ", ".join(words), "", verdict_mark(results), "diagnose.verdict")
    yield from (_tile("Missing", step) for step in results.steps)
    if results.nearest:
        yield _tile("Nearest, not named", results.nearest)
    gap = results.gap
    chi2 = results.chi2_nu
    noise = "noise alone" if results.grade else "noise alone, at most"
    note = f"before → after; {noise} {number(gap.floor, '.4f')}"
    yield KeyNumber(
        "Gap to unseen data", _change(gap.before, gap.after, ".4f"), note, key="diagnose.gap.before"
    )
    after = f"with {results.nearest.effect}, not named" if results.nearest else "after"
    note = f"before → {after}; noise alone gives 1" if results.grade else "of the offsets, before → after"
    before, now = (number(one, ".2f" if abs(one) < MANY else ".0f") for one in (chi2.before, chi2.after))
    yield KeyNumber("χ²/ν", f"{before} → {now}", note, key="diagnose.chi2_nu")
    known = [step for step in _steps(results) if is_known(step.held_out_z)]
    if known:
        least = min(known, key=lambda step: step.held_out_z)
        note = f"for the model with {_name(least)}, against the one without; {CLEAR_Z}"
        z = f"z {least.held_out_z:.1f}"
        yield KeyNumber(f"Unseen {results.held_out}", z, note, key="diagnose.steps.held_out_z")
    for step in _steps(results)[:1]:
        for other in step.ranking[1:2]:
            name = other.name.replace("_", " ")
            yield KeyNumber("Runner-up", name, _deficit(step, other), key="diagnose.steps.ranking")
    if results.rest is not None:
        rest = results.rest
        kind = f"{rest.symmetry}, {rest.time}" if _lacking(results) else "nothing significant"
        light = number(rest.light_fraction, ".2%")
        note = f"of the light misplaced beyond noise; {kind}"
        yield KeyNumber("Left", light, note, key="diagnose.rest.light_fraction")


def verdict_table(results: DiagnoseResults) -> Table:
    """Return the verdict in short, one line for each question that a reader asks first."""
    nearest = results.nearest
    error = results.defocus_error_nm
    counts = Counter(x.outcome for x in results.tried)
    left = results.rest.text if results.rest else ""
    rows = [
        ("grade", f"{results.grade}: {GRADES[results.grade]}" if results.grade in GRADES else ""),
        *(("missing", f"{step.phrase} ({number(step.significance, '.0f', 'σ')})") for step in results.steps),
        ("nearest, not named", nearest.phrase if nearest else ""),
        ("why it is not named" if nearest else "why", results.why_unknown),
        (
            "error of the ramp",
            f"{_change(error.before, error.after, '.1f')} nm RMS against commanded → against what was found"
            if is_known(error.before)
            else "",
        ),
        ("data that no fit has seen", _held_out(results)),
        *(("runner-up", _runner_up(step)) for step in _steps(results)[:1]),
        ("left", left if _lacking(results) or not left else f"nothing significant ({left})"),
        ("adjusted, not named", "; ".join(one.phrase or one.effect for one in results.adjusted)),
        # Facts of the instrument from which a calibration with the model begins.
        (
            f"free in {results.model} as well",
            "; ".join(
                f"{name.replace('_', ' ')}, from {in_one_line(parameter_rows(at))}"
                for name, at in results.open_facts.items()
            ),
        ),
        ("tried", ", ".join(f"{counts[key]} {words}" for key, words in OUTCOMES.items() if counts[key])),
    ]
    return Table(("", ""), [row for row in rows if row[1]], "In short", prose=True)


def _lacking(results: DiagnoseResults) -> bool:
    return results.verdict == "unknown" or results.unexplained


def _steps(results: DiagnoseResults) -> list[StepRow]:
    """Effects found, and the nearest where the verdict is unknown."""
    return [*results.steps, *([results.nearest] if results.nearest else [])]


def _name(step: StepRow) -> str:
    return step.effect.replace("_", " ")


def _change(before: float, after: float, pattern: str) -> str:
    return f"{number(before, pattern)} → {number(after, pattern)}"


def _values(step: StepRow) -> list[Row]:
    return parameter_rows(step.shown or step.parameters, step.shown_sigma or step.sigma)


def _tile(label: str, step: StepRow) -> KeyNumber:
    """A tile with a name: its first number, and the others small."""
    rows, head, kind = _values(step), f"{label}: {_name(step)}", kind_of(step.effect)
    if not rows:
        return KeyNumber(head, step.phrase or step.effect, key=kind)
    if len(rows) > 1 and all(row.name == rows[0].name for row in rows):  # pixels
        note = "; ".join(row.value for row in rows)
        return KeyNumber(head, plural(len(rows), rows[0].name), note, key=kind)
    others = in_one_line(rows[1 : 1 + NUMBERS_IN_NOTE])
    value = " ".join(filter(None, (rows[0].value, rows[0].unit)))
    return KeyNumber(head, value, "; ".join(filter(None, [rows[0].name, others])), key=kind)


def _deficit(step: StepRow, other: Ranked) -> str:
    if other.name in step.indistinguishable:
        return f"these data do not distinguish it from {_name(step)}"
    first = step.ranking[0]
    less = f"loses by Δχ² {number(first.gain - other.gain, '.3g')}"
    explains = f"explains {number(other.explained, '.1%')}, not {number(first.explained, '.1%')}"
    z = f"; unseen data against it: z {other.held_out_z:.1f}" if is_known(other.held_out_z) else ""
    return f"{less}; {explains}{z}"


def _runner_up(step: StepRow) -> str:
    if len(step.ranking) < 2:
        return "none: nothing else promised enough to be fitted" if step.ranking else ""
    return f"{step.ranking[1].name}: {_deficit(step, step.ranking[1])}"


def _held_out(results: DiagnoseResults) -> str:
    known = [step for step in _steps(results) if is_known(step.held_out_z)]
    wanted = ", ".join(f"{step.effect} wanted with z {step.held_out_z:.1f}" for step in known)
    gap, count = results.gap, results.frames.held_out
    closed = f": {number(gap.shrink, '.0%')} of what is above noise is closed" if is_known(gap.shrink) else ""
    return (
        (f"{plural(count, 'frame')}; " if count else "")
        + (f"{wanted} ({CLEAR_Z}); " if wanted else "")
        + f"gap {_change(gap.before, gap.after, '.4f')}, noise alone {number(gap.floor, '.4f')}{closed}"
    )


# -- names: how they compared, their sizes, what they are not distinguished from ---------------


def _found(results: DiagnoseResults) -> list[Table]:
    """Names with value, standard error and share; the nearest one where the verdict is unknown."""
    columns = (
        "name",
        "parameter",
        "value",
        "unit",
        "significance",
        "explained",
        "explained where it acts",
        "z, unseen data",
        "not distinguished from",
    )
    rows, whole = [], []
    for step in _steps(results):
        values = _values(step)
        head = (
            number(step.significance, ".1f", "σ"),
            number(step.explained, ".0%"),
            number(step.share, ".1%"),
            number(step.held_out_z, ".1f"),
            ", ".join(step.indistinguishable) or "–",
        )
        for place, row in enumerate(shortened(values)):
            rows.append((*("", *row), *[""] * len(head)) if place else (step.effect, *row, *head))
        if len(values) > MOST_ROWS:
            title = f"All values of {step.effect}"
            whole.append(Table(("parameter", "value", "unit"), values, title, folded=True))
    return [Table(columns, rows, "Found" if results.steps else "Nearest", FOUND), *whole]


def _candidates(results: DiagnoseResults) -> list[Table]:
    """How the candidates for every name compared, where there were several."""
    columns = ("name", "explained", "Δχ² to the first", "significance", "z, unseen data against it")
    tables = []
    for step in _steps(results):
        rows = [
            (
                row.name,
                number(row.explained, ".1%"),
                number(step.ranking[0].gain - row.gain, ".3g"),
                number(row.significance, ".0f", "σ"),
                number(row.held_out_z, ".1f") if place else MISSING,
            )
            for place, row in enumerate(step.ranking)
        ]
        if len(rows) > 1:
            tables.append(Table(columns, rows, f"Candidates for {_name(step)}"))
    return tables


def separation_table(results: DiagnoseResults) -> Table:
    """Return what would distinguish the names from others that fit as well."""
    rows = []
    for step in results.steps:
        for other in step.alternatives:
            then = f" (|cos| then {number(other.likeness_then, '.2f')})"
            second = f"; a second recording {other.second_recording}{then}" if other.second_recording else ""
            rows.append((f"{step.effect} or {other.name}", other.reason, f"{other.separated_by}{second}"))
    return Table(("effects", "why", "what distinguishes them"), rows, "Not distinguished", prose=True)


def sharing_tables(results: DiagnoseResults) -> list[Table]:
    """Return what recordings of several stars and nights share: findings, values of each, wavefronts."""
    if not results.recordings:
        return []
    values: list[tuple[str, ...]] = []
    for effect, own in ((one.effect, own) for one in results.sharing for own in one.values):
        errors, seen = dict(rows_of(own.sigma)), number(own.significance, ".1f", "σ")
        for place, (name, value) in enumerate(rows_of(own.parameters)):
            text = rounded_by_error(value, errors.get(name)) if isinstance(value, float) else str(value)
            values.append(("", "", name, text, "") if place else (effect, own.recording, name, text, seen))
    found = Table.of(
        results.sharing,
        {
            "name": lambda one: one.effect,
            "finding": lambda one: FINDINGS.get(one.finding, one.finding),
            "differences": lambda one: number(one.significance, ".1f", "σ"),
            "Δχ² (parameters)": lambda one: f"{number(one.chi2_fall, '.0f')} ({one.parameters})",
            "held-out z": lambda one: number(one.held_out_z, ".1f"),
        },
        "One value for all recordings, or each its own",
    )
    stars = Table.of(
        results.recordings,
        {
            "recording": lambda one: one.name,
            "star": lambda one: one.star or MISSING,
            "change of the NCPAs, RMS per mode [nm]": lambda one: rounded_by_error(
                one.ncpa_change_nm, one.sigma_nm
            ),
        },
        "Stars and nights",
    )
    columns = ("name", "recording", "parameter", "value", "seen there")
    return [found, Table(columns, values, "Fitted to each recording", folded=True), stars]


def _tried(results: DiagnoseResults) -> Table:
    """Every effect of the catalogue and what became of it, in the order of the outcomes."""
    order = dict(zip(OUTCOMES, range(len(OUTCOMES)), strict=True))
    return Table.of(
        sorted(results.tried, key=lambda one: order.get(one.outcome, len(order))),
        {
            "effect": lambda one: one.effect,
            "outcome": lambda one: OUTCOMES.get(one.outcome, one.outcome),
            "why": lambda one: one.reason,
        },
        f"What was tried: {plural(len(results.tried), 'effect')}, and why the rest was not named",
        folded=True,
        prose=True,
    )


def _modes(results: DiagnoseResults) -> Table | None:
    before, after, sigma = results.zernike_nm.before, results.zernike_nm.after, results.sigma_nm
    both = [noll for noll in after if noll in before]
    if not any(abs(after[noll] - before[noll]) > 1e-6 for noll in both):
        return None
    return Table.of(
        both,
        {
            "Noll": str,
            "before [nm]": lambda noll: number(before[noll], "+.1f"),
            "after [nm]": lambda noll: with_error(after[noll], sigma.get(noll), "+.1f"),
        },
        "NCPAs with the old and with the new model",
        folded=True,
    )


def _limits(results: DiagnoseResults) -> list[Block]:
    limits = Table(
        ("effect", "smallest size that would have been seen"),
        [(name, sizes(public)) for name, public in results.mdb.items()],
        "Not seen",
        "Effects that were not seen: above these sizes they would have been.",
        folded=True,
    )
    none, advice = ("none of those tried", MISSING), results.second_recording
    shows = {name: (one.recording, sizes(one.smallest)) for name, one in advice.items()}
    hidden = Table(
        ("effect", "second recording that shows it", "smallest size seen then"),
        [(name, *shows.get(name, none)) for name in results.untestable],
        "Not to be seen in these data: the free parameters imitate it",
        folded=True,
    )
    texts = [Text(f"Noise: {results.noise.text}.")] if results.noise else []
    if fine := results.fine_structure:
        texts.append(Text(FINE.format(number(fine.ratio, ".2f"), number(fine.significance, ".1f"))))
    return [limits, hidden, *texts]


# -- figures -----------------------------------------------------------------------------------


def _models(of: Diagnosis) -> dict[str, tuple[np.ndarray, str]]:
    """Predicted images with what is said of them, by when; one where before and after are the same."""
    before, after = of["before_e"], of["after_e"]
    if np.array_equal(before, after, equal_nan=True):
        return {"": (after, "")}
    return {" before": (before, "By the model as it was."), " after": (after, "With what was found.")}


def _residuals(of: Diagnosis) -> Block:
    measured, models = of["measured_e"], _models(of)
    residuals = {
        f"Residual{when}": (measured - model, f"Measured − predicted. {caption}")
        for when, (model, caption) in models.items()
    }
    width: Width = "two-thirds" if len(models) > 1 else "third"
    sigma, peak_e = of.error_of("measured_e"), float(np.nanmax(of["after_e"]))
    return residual_views("dia-left", residuals, sigma, peak_e, of.pixel_scale_mas, width)


def _images(of: Diagnosis) -> Block:
    models = {f"Predicted{when}": model for when, model in _models(of).items()}
    return image_views("dia-images", {"Measured": (of["measured_e"], HELD_OUT)} | models, of.pixel_scale_mas)


def _leading(of: Diagnosis) -> Figure:
    mode = of["leading_mode"]
    scale = symmetric_scale(percentile(LEADING_PERCENTILE, mode) or 1.0)
    drawing = image_panel("dia-leading", mode, scale, of.pixel_scale_mas, "σ", SIGNED)
    return Figure(drawing, "What varies most", LEADING, "third")


def _rest(of: Diagnosis) -> Figure | None:
    """What the final model misses as an image; the verdict has the words."""
    rest, after, sigma, mas = of.results.rest, of["after_e"], of.error_of("measured_e"), of.pixel_scale_mas
    residual, ring = of["measured_e"] - after, None
    if rest is None:
        return None
    left = residual * np.nan if sigma is None else in_sigma(residual, sigma)
    if mas:
        row, column = star_position(np.nan_to_num(after))
        y, x = row - (after.shape[0] - 1) / 2, column - (after.shape[1] - 1) / 2
        ring = Ring(x * mas + rest.where.x_mas, y * mas + rest.where.y_mas, rest.where.extent_mas)
    scale = symmetric_scale(max(3.0, percentile(PERCENTILE, left)))
    drawing = image_panel("dia-rest", left, scale, mas, "σ", SIGNED, ring=ring)
    return Figure(drawing, "What is left", REST, "third")


def _added_wavefront(of: Diagnosis) -> Figure | None:
    opd, added = of["added_opd_nm"], of.results.added_wavefront
    caption = (
        f"{number(added.rms_nm, '.0f', 'nm RMS')}, {number(added.pv_nm, '.0f', 'nm')} peak to valley "
        "over the clear pupil, x and y as in the images."
    )
    return _added("dia-opd", opd, "nm", ADDED_PERCENTILE, "Wavefront added", caption)


def _added_amplitude(of: Diagnosis) -> Figure | None:
    """Of a wavefront only the edges would show: drawn where a name changes the amplitude in the pupil."""
    amplitude, names = 100 * of["added_amplitude"], [step.effect for step in of.results.steps]
    kinds = [kind for kind in CATALOGUE.values() if any(name.startswith(kind.name) for name in names)]
    if not any(kind.plane == "pupil" and not kind.aberration for kind in kinds):
        return None
    caption = "Change of the amplitude in the pupil, in % of what it is where the pupil is clear."
    return _added("dia-amplitude", amplitude, "%", 100.0, "Amplitude added", caption)


def _added(
    name: str, values: np.ndarray, unit: str, percent: float, title: str, caption: str
) -> Figure | None:
    if not np.nanmax(np.abs(values), initial=0.0) > NOTHING:
        return None
    axes: dict[str, Any] = {"xlabel": "x →", "ylabel": "y →", "xticks": [], "yticks": []}
    return Figure(pupil_map(name, values, percentile(percent, values), unit, **axes), title, caption, "third")


def _profile(of: Diagnosis) -> Figure:
    measured, before, after = (of[name] for name in ("measured_e", "before_e", "after_e"))
    sigma = of.error_of("measured_e")
    images = {
        "measured": (measured, INK, "o"),
        "|residual| before": (np.abs(measured - before), ORANGE, "-"),
        "|residual| after": (np.abs(measured - after), BLUE, "-"),
        "1σ noise": (measured * np.nan if sigma is None else sigma, GREEN, "--"),
    }
    drawing = star_profile("dia-profile", images, after, of.pixel_scale_mas)
    return Figure(drawing, "Radial profile", f"About the star's centroid. {HELD_OUT}", "third")


def _quantiles(of: Diagnosis) -> Figure | None:
    measured, sigma = of["measured_e"], of.error_of("measured_e")
    models = of.known({look: f"{when}_e" for when, look in BEFORE_AFTER.items()})
    if sigma is None:
        return None
    residuals = {look: in_sigma(measured - model, sigma) for look, model in models.items()}
    return quantile_figure("dia-quantiles", residuals)


def _ramp(of: Diagnosis) -> Figure:
    """A ramp as its diagnosis sees it: estimates against what was commanded and against what was found."""
    commanded, corrected, estimated = (of[f"{name}_nm"] for name in ("commanded", "corrected", "estimated"))

    def draw(canvas: Canvas) -> None:
        top, bottom = canvas.subplots(2, sharex=True, height_ratios=(3, 2))
        frames = np.arange(len(commanded))
        top.step(frames, commanded, where="mid", color=INK, linewidth=0.9, label="commanded")
        top.plot(frames, estimated, ".", color=BLUE, label="estimated")
        bottom.axhline(0, color=INK, linewidth=0.9)
        bottom.plot(frames, estimated - commanded, ".", color=ORANGE, label="against commanded")
        if np.any(np.abs(corrected - commanded) > 1e-6):
            bottom.plot(frames, estimated - corrected, ".", color=BLUE, label="against what was found")
        top.set(ylabel="defocus [nm RMS]")
        bottom.set(xlabel="frame", ylabel="difference [nm]")
        canvas.legend(loc="outside upper center", ncols=2)

    return Figure(svg("dia-ramp", (4.8, 3.6), draw), "The ramp", RAMP)
