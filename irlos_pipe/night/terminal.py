"""What `irlos night` and `irlos trend` print: summaries that fit a terminal, everything as JSON or CSV."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.files.json import json_text
from irlos_pipe.night.reduce import Job
from irlos_pipe.night.stability import DAY_S, Structure, Validity
from irlos_pipe.night.state import Night, RunState, page_path
from irlos_pipe.night.trend import OF_THE_SKY, Owner, Series, Trend, is_mode
from irlos_pipe.pipeline import Step
from irlos_pipe.product.printed import ShownTrend
from irlos_pipe.report.text import number, plural

PLAN_KEYS = ("run", "stage", "action", "reason")
COLUMNS = ("number", "value", "±", "expected", "nights", "")
STRUCTURE_COLUMNS = ("lag [days]", "change [nm RMS]", "95 %", "noise alone", "pairs")
VERDICT_COLUMNS = ("night", "group", "verdict", "effects")
POINT_COLUMNS = (
    "name", "recipe", "configuration", "night", "run", "unix_s", "value", "sigma", "low", "high", "alarm",
)  # fmt: skip
MOST_VERDICTS = 3  # verdicts of `diagnose` that are shown
FAR = 2.0  # times the longest lag between calibrations, beyond which no drift is extrapolated


# -- irlos night --------------------------------------------------------------------------------


def attention_line(state: RunState, tree: Path) -> str:
    """Return one line on the nights of `state` that need a look, with their pages in `tree`; "" when none."""
    nights = [night for night in state.nights.values() if night.failures or night.doubts]
    if not nights:
        return ""
    if len(nights) == 1:
        problems = [*nights[0].failures, *nights[0].doubts]
        page = page_path(tree, nights[0].date)
        return f"night {nights[0].date}: {problems[0]}{and_more(problems)}; see {page}"
    dates = ", ".join(night.date for night in nights[:3]) + (" ..." if len(nights) > 3 else "")
    return f"{len(nights)} of {len(state.nights)} nights need a look ({dates}); see {tree}/night_*.html"


def night_text(state: RunState, tree: Path) -> str:
    """Return one line per job and per page, for a `state` of a run and the `tree` of its results."""
    rows = []
    for date, night in sorted(state.nights.items()):
        for one in night.reduced.values():
            why = "; ".join(one.reasons) or one.problem
            rows.append((date, one.name.partition("/")[2], one.status.replace("_", " "), one.action, why))
        rows.append((date, "page", "", "", str(page_path(tree, date))))
    return aligned(rows)


def night_json(state: RunState, tree: Path) -> str:
    """Return the outcome of a run as JSON, for its `state` and the `tree` of its results."""
    nights = [_night(one, tree) for one in state.nights.values()]
    return _json("irlos-night", exit_code=state.exit_code, nights=nights)


def nothing_json(reason: str) -> str:
    """Return the JSON of a run that had nothing to do."""
    return _json("irlos-night", exit_code=ExitCode.NOTHING_TO_DO, nights=[], nothing=reason)


def _json(schema: str, **content: Any) -> str:
    return json_text({"schema": schema, "schema_version": 1} | content).rstrip()


def _night(night: Night, tree: Path) -> dict[str, Any]:
    return {
        "night": night.date,
        "page": page_path(tree, night.date),
        "recordings": len(night.recordings),
        "reductions": [asdict(one) for one in night.reduced.values()],
        "calibrations": {job.task.name: job.group.choice for job in night.jobs if job.group.choice},
        "left_out": [{"path": one.recording.path, "reason": one.reason} for one in night.not_reduced],
        "unusable": [
            {"path": one.recording.path, "night": one.recording.night, "problem": one.reason}
            for one in night.unusable
        ],
        "failures": night.failures,
        "doubts": night.doubts,
        "known": night.known,
        "guessed": night.guessed,
    }


def plan_text(state: RunState, plan: Sequence[tuple[Job, list[Step] | None]], as_json: bool) -> str:
    """Return what `plan_night` found, `state` and `plan`, one line per stage; a JSON list if `as_json`."""
    rows = []
    for job, steps in plan:
        if steps is None:
            rows.append((job.task.name, "all stages", "run", "no products yet"))
        rows += [(job.task.name, step.name, step.action.value, step.reason) for step in steps or ()]
    for night in state.nights.values():
        quiet = [f"{one.recording.path}: {one.reason}" for one in night.not_reduced if not one.alarming]
        rows += [("left out", "", "", line) for line in (*night.failures, *quiet)]
        rows += [("night guessed", "", "", line) for line in night.guessed]
    if as_json:
        return json_text([dict(zip(PLAN_KEYS, row, strict=True)) for row in rows]).rstrip()
    return aligned(rows)


# -- irlos trend --------------------------------------------------------------------------------


def trend_text(trend: Trend, everything: bool = False) -> str:
    """Return the last value of every number with what is expected, the stability of the NCPAs, and verdicts.

    Modes of the `trend` that are as expected are only counted, and old verdicts left out, unless `everything`
    is asked for.
    """
    by_owner = sorted(trend.series, key=lambda one: one.owner)
    parts = [
        _numbers_text(owner, list(members), trend, everything)
        for owner, members in groupby(by_owner, lambda one: one.owner)
    ]
    for (recipe, _), (structure, _) in trend.stabilities.items():
        title = f"Stability of the NCPAs, Noll 4 and up ({recipe}):"
        parts.append(f"{title}\n{aligned([STRUCTURE_COLUMNS, *_structure_rows(structure)])}")
    parts += [validity_text(validity) for _, validity in trend.stabilities.values()]
    chosen = trend.verdicts if everything else trend.verdicts[-MOST_VERDICTS:]
    verdicts = [(one.night, one.group, one.verdict, ", ".join(one.effects)) for one in chosen]
    if verdicts:
        parts.append("What the model lacks:\n" + aligned([VERDICT_COLUMNS, *verdicts]))
    return "\n\n".join(parts)


def _numbers_text(owner: Owner, members: Sequence[Series], trend: Trend, everything: bool) -> str:
    night = max(one.last.night for one in members)
    shown = [one for one in members if everything or one.last.alarm or not is_mode(one.name)]
    rows = [_row(one, night) for one in shown]
    lines = [f"{owner[0]}, last night {night}" + (f" ({owner[1]})" if owner[1] else "")]
    lines += [aligned([COLUMNS, *rows])] if rows else []
    hidden, modes = [one for one in members if one not in shown], sum(is_mode(one.name) for one in members)
    judged = sum(one.last.band is not None for one in hidden)
    said = ((judged, "are as expected"), (len(hidden) - judged, "have too few nights to expect a value"))
    lines += [f"{count} of {modes} modes {what} (--all lists them)" for count, what in said if count]
    own = [one for one in trend.wavefronts if (one[0].recipe, one[0].configuration) == owner]
    lines += [f"all modes: {test}{'' if test.holds else '  ALARM'}" for _, test in own[-1:]]
    return "\n".join(lines)


def _row(series: Series, night: str) -> tuple[str, ...]:
    last = series.last
    unknown = "" if series.name in OF_THE_SKY else "too few nights"
    remarks = (["ALARM"] if last.alarm else []) + ([f"of {last.night}"] if last.night != night else [])
    return (
        series.name,
        f"{last.value:.4g}",
        number(last.sigma, ".2g"),
        f"{last.band.low:.4g} to {last.band.high:.4g}" if last.band else unknown,
        str(len({point.night for point in series.points})),
        " ".join(remarks),
    )


def _structure_rows(found: Structure) -> Iterator[tuple[str, ...]]:
    columns = (found.lag_s / DAY_S, found.change_nm, found.low_nm, found.high_nm, found.noise_nm2**0.5)
    for days, change, low, high, noise, pairs in zip(*columns, found.pairs, strict=True):
        yield f"{days:.3g}", f"{change:.2f}", f"{low:.1f} to {high:.1f}", f"{noise:.2f}", str(pairs)


def validity_text(validity: Validity) -> str:
    """Return in one sentence how long a calibration is valid."""
    limit = f"{validity.change_nm:g} nm RMS"
    if validity.days == 0:
        return f"From one calibration to the next the NCPAs change by more than {limit}."
    if at_least := _at_least(validity):
        return f"The NCPAs stay within {limit} for at least {at_least} days: no drift to that is seen."
    return f"The NCPAs stay within {limit} for {validity.days:.3g} days ({_interval(validity)})."


def validity_number(validity: Validity) -> tuple[str, str]:
    """Return how long a calibration is valid in days, and what that means."""
    limit = f"{validity.change_nm:g} nm RMS"
    if validity.days == 0:
        return "0 days", f"changes by more than {limit} at once"
    if at_least := _at_least(validity):
        return f"≥ {at_least} days", f"within {limit}; no drift to that seen"
    return f"{validity.days:.3g} days", f"within {limit}; {_interval(validity)}"


def _at_least(validity: Validity) -> str:
    """The days that are safe, where the time is far beyond what the calibrations cover; else ""."""
    far = validity.days > FAR * validity.seen_days
    return f"{min(validity.low_days, validity.seen_days):.3g}" if far else ""


def _interval(validity: Validity) -> str:
    known = validity.high_days < float("inf")
    return f"95 %: {validity.low_days:.3g} {f'to {validity.high_days:.3g}' if known else 'or more'}"


def trend_json(trend: Trend) -> str:
    """Return all points, bands, verdicts and alarms as JSON."""
    return ShownTrend(
        series=list(map(_series, trend.series)),
        wavefronts=[{"run": one.run, "night": one.night, **asdict(test)} for one, test in trend.wavefronts],
        stability=[
            {"recipe": recipe, "configuration": configuration, **asdict(structure), "valid": asdict(validity)}
            for (recipe, configuration), (structure, validity) in trend.stabilities.items()
        ],
        verdicts=[asdict(one) for one in trend.verdicts],
        alarms=trend.alarms(trend.last_night),
    ).text()


def _series(series: Series) -> dict[str, Any]:
    points = [
        {name: getattr(one, name) for name in ("run", "night", "unix_s", "value", "sigma")}
        | {"band": one.band and [one.band.low, one.band.high]}
        for one in series.points
    ]
    recipe, configuration = series.owner
    head = {"name": series.name, "recipe": recipe, "configuration": configuration}
    return head | {"limits": series.limits, "points": points}


def trend_csv(trend: Trend) -> str:
    """Return every point with what was expected of it as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(POINT_COLUMNS)
    for one in (one for series in trend.series for one in series.points):
        low, high = (one.band.low, one.band.high) if one.band else ("", "")
        known = [getattr(one, name) for name in POINT_COLUMNS[:-3]]
        writer.writerow((*known, low, high, int(bool(one.alarm))))
    return text.getvalue()


def alarms_line(trend: Trend) -> str:
    """Return one line on the alarms of the last night; "" without one."""
    found = trend.alarms(trend.last_night)
    return f"{plural(len(found), 'number')} out of band: {found[0]}{and_more(found)}" if found else ""
