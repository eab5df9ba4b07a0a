"""What a diagnosis says at first sight: the verdict with its numbers, for the top of the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Literal

from irlos_pipe.diagnosis.records import Ranked
from irlos_pipe.report.content import KeyNumber, Table
from irlos_pipe.report.effect_words import in_one_line, parameter_rows
from irlos_pipe.report.text import is_known, number, plural
from irlos_pipe.stages.diagnose.results import DiagnoseResults, StepRow

Mark = Literal["good", "bad"]
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
NUMBERS_IN_NOTE = 3
MANY = 100.0  # χ²/ν from which decimals say nothing
CLEAR_Z = "3 is clear"


def verdict_mark(results: DiagnoseResults) -> Mark:
    """Return whether the model with what was named lacks nothing."""
    return "bad" if results.verdict == "unknown" or results.unexplained else "good"


def verdict_numbers(results: DiagnoseResults) -> Iterator[KeyNumber]:
    """Yield the tiles of a diagnosis: names, gap, χ²/ν, what unseen data say, the runner-up, the rest."""
    if not results.verdict:
        return
    words = [VERDICTS.get(results.verdict, results.verdict)]
    words += [results.grade] if results.grade not in ("", results.verdict) else []
    yield KeyNumber("Diagnosis", ", ".join(words), "", verdict_mark(results))
    yield from (_name("Missing", step) for step in results.steps)
    if results.nearest:
        yield _name("Nearest, not named", results.nearest)
    yield _gap(results)
    chi2 = results.chi2_nu
    after = f"with {results.nearest.effect}, not named" if results.nearest else "after"
    of = f"before → {after}; noise alone gives 1" if results.grade else "of the offsets, before → after"
    yield KeyNumber("χ²/ν", f"{_chi2(chi2.before)} → {_chi2(chi2.after)}", of)
    yield from _unseen(results)
    yield from _runner_up(results)
    if results.rest is not None:
        lacking = results.verdict == "unknown" or results.unexplained
        kind = f"{results.rest.symmetry}, {results.rest.time}" if lacking else "nothing significant"
        light = number(results.rest.light_fraction, ".2%")
        yield KeyNumber("Left", light, f"of the light misplaced beyond noise; {kind}")


def verdict_table(results: DiagnoseResults) -> list[Table]:
    """Return the verdict in short, one line for each question that a reader asks first."""
    rows = [
        ("grade", f"{results.grade}: {GRADES[results.grade]}" if results.grade in GRADES else ""),
        *(("missing", f"{step.phrase} ({number(step.significance, '.0f', 'σ')})") for step in results.steps),
        *((("nearest, not named", results.nearest.phrase),) if results.nearest else ()),
        ("why it is not named" if results.nearest else "why", results.why_unknown),
        ("error of the ramp", _ramp_error(results)),
        ("data that no fit has seen", _held_out(results)),
        *(("runner-up", _lost(step)) for step in _shown(results)[:1]),
        ("left", _left(results)),
        ("adjusted, not named", "; ".join(one.phrase or one.effect for one in results.adjusted)),
        (f"free in {results.model} as well", _left_free(results)),
        ("tried", _tried(results)),
    ]
    known = [row for row in rows if row[1]]
    return [Table(("", ""), known, "In short", prose=True)] if known else []


def _left_free(results: DiagnoseResults) -> str:
    """Facts of the instrument from which a calibration with the model begins."""
    facts = results.open_facts.items()
    return "; ".join(
        f"{name.replace('_', ' ')}, from {in_one_line(parameter_rows(at))}" for name, at in facts
    )


def _ramp_error(results: DiagnoseResults) -> str:
    error = results.defocus_error_nm
    if not is_known(error.before):
        return ""
    return f"{_change(error.before, error.after, '.1f')} nm RMS against commanded → against what was found"


def _left(results: DiagnoseResults) -> str:
    if results.rest is None:
        return ""
    lacking = results.verdict == "unknown" or results.unexplained
    return results.rest.text if lacking else f"nothing significant ({results.rest.text})"


def _shown(results: DiagnoseResults) -> list[StepRow]:
    return [*results.steps, *([results.nearest] if results.nearest else [])]


def _change(before: float, after: float, pattern: str) -> str:
    return f"{number(before, pattern)} → {number(after, pattern)}"


def _chi2(value: float) -> str:
    return number(value, ".2f" if abs(value) < MANY else ".0f")


def _name(label: str, step: StepRow) -> KeyNumber:
    """A tile with a name: its first number, and the others small."""
    rows = parameter_rows(step.shown or step.parameters, step.shown_sigma or step.sigma)
    head = f"{label}: {step.effect.replace('_', ' ')}"
    if not rows:
        return KeyNumber(head, step.phrase or step.effect)
    if len(rows) > 1 and all(row.name == rows[0].name for row in rows):  # pixels
        return KeyNumber(head, plural(len(rows), rows[0].name), "; ".join(row.value for row in rows))
    others = in_one_line(rows[1 : 1 + NUMBERS_IN_NOTE])
    value = " ".join(filter(None, (rows[0].value, rows[0].unit)))
    return KeyNumber(head, value, "; ".join(filter(None, [rows[0].name, others])))


def _gap(results: DiagnoseResults) -> KeyNumber:
    gap = results.gap
    noise = "noise alone" if results.grade else "noise alone, at most"
    note = f"before → after; {noise} {number(gap.floor, '.4f')}"
    return KeyNumber("Gap to unseen data", _change(gap.before, gap.after, ".4f"), note)


def _unseen(results: DiagnoseResults) -> Iterator[KeyNumber]:
    known = [step for step in _shown(results) if is_known(step.held_out_z)]
    if known:
        least = min(known, key=lambda step: step.held_out_z)
        note = f"for the model with {least.effect.replace('_', ' ')}, against the one without; {CLEAR_Z}"
        yield KeyNumber(f"Unseen {results.held_out}", f"z {least.held_out_z:.1f}", note)


def _runner_up(results: DiagnoseResults) -> Iterator[KeyNumber]:
    for step in _shown(results)[:1]:
        other = _second(step)
        if other is not None:
            value = other.name.replace("_", " ")
            yield KeyNumber("Runner-up", value, _deficit(step, other))


def _second(step: StepRow) -> Ranked | None:
    return step.ranking[1] if len(step.ranking) > 1 else None


def _deficit(step: StepRow, other: Ranked) -> str:
    if other.name in step.indistinguishable:
        return f"these data do not distinguish it from {step.effect.replace('_', ' ')}"
    first = step.ranking[0]
    less = f"loses by Δχ² {number(first.gain - other.gain, '.3g')}"
    explains = f"explains {number(other.explained, '.1%')}, not {number(first.explained, '.1%')}"
    z = f"; unseen data against it: z {other.held_out_z:.1f}" if is_known(other.held_out_z) else ""
    return f"{less}; {explains}{z}"


def _lost(step: StepRow) -> str:
    other = _second(step)
    if other is None:
        return "none: nothing else promised enough to be fitted" if step.ranking else ""
    return f"{other.name}: {_deficit(step, other)}"


def _held_out(results: DiagnoseResults) -> str:
    known = [step for step in _shown(results) if is_known(step.held_out_z)]
    frames = f"{plural(results.frames.held_out, 'frame')}; " if results.frames.held_out else ""
    wanted = [f"{step.effect} wanted with z {step.held_out_z:.1f}" for step in known]
    clear = f" ({CLEAR_Z})" if wanted else ""
    gap = results.gap
    text = f"gap {_change(gap.before, gap.after, '.4f')}, noise alone {number(gap.floor, '.4f')}"
    closed = f": {number(gap.shrink, '.0%')} of what is above noise is closed" if is_known(gap.shrink) else ""
    return f"{frames}{', '.join(wanted)}{clear}{'; ' if wanted else ''}{text}{closed}"


def _tried(results: DiagnoseResults) -> str:
    counts = Counter(one.outcome for one in results.tried)
    return ", ".join(f"{counts[key]} {words}" for key, words in OUTCOMES.items() if counts[key])


def tried_tables(results: DiagnoseResults) -> list[Table]:
    """Return every effect of the catalogue and what became of it, in the order of the outcomes."""
    order = list(OUTCOMES)
    rows = [
        (one.effect, OUTCOMES.get(one.outcome, one.outcome), one.reason)
        for one in sorted(
            results.tried, key=lambda one: order.index(one.outcome) if one.outcome in order else 99
        )
    ]
    title = f"What was tried: {plural(len(rows), 'effect')}, and why the rest was not named"
    return [Table(("effect", "outcome", "why"), rows, title, folded=True, prose=True)] if rows else []
