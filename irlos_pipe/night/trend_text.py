"""What `irlos trend` prints: a summary that fits a terminal, everything as text, or JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import Any

from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.files.json import json_text
from irlos_pipe.night.bands import Band
from irlos_pipe.night.database import Point
from irlos_pipe.night.stability import DAY_S, Structure, Validity
from irlos_pipe.night.trend import OF_THE_SKY, Series, Trend, Wavefront, alarm_text
from irlos_pipe.report.text import number, plural

COLUMNS = ("number", "value", "±", "expected", "nights", "")
STRUCTURE_COLUMNS = ("lag [days]", "change [nm RMS]", "95 %", "noise alone", "pairs")
VERDICT_COLUMNS = ("night", "group", "verdict", "effects")
POINT_COLUMNS = (
    "name", "recipe", "configuration", "night", "run", "unix_s", "value", "sigma", "low", "high", "alarm",
)  # fmt: skip
UNITS = ("nm", "arcsec", "mas")
SPELLING = {"noll": "Noll", "ncpa": "NCPAs", "ao": "AO"}
MOST_VERDICTS = 3
FAR = 2.0  # times the longest lag between calibrations: a drift is not drawn out further


def trend_text(trend: Trend, everything: bool = False) -> str:
    """Return the last value of every number with what is expected, the stability of the NCPAs, and verdicts.

    Parameters
    ----------
    trend : Trend
        All of it, or chosen numbers.
    everything : bool
        Every mode and every verdict, too; otherwise modes that are as expected are only counted.
    """
    parts = [
        _numbers_text(*who, list(members), trend, everything)
        for who, members in groupby(sorted(trend.series, key=_owner), _owner)
    ]
    for (recipe, _), structure in trend.structures.items():
        title = f"Stability of the NCPAs, Noll 4 and up ({recipe}):"
        parts.append(f"{title}\n{aligned([STRUCTURE_COLUMNS, *_structure_rows(structure)])}")
    parts += [validity_text(one) for one in trend.validities.values()]
    chosen = trend.verdicts if everything else trend.verdicts[-MOST_VERDICTS:]
    verdicts = [(one.night, one.group, one.verdict, ", ".join(one.effects)) for one in chosen]
    if verdicts:
        parts.append("What the model lacks:\n" + aligned([VERDICT_COLUMNS, *verdicts]))
    return "\n\n".join(parts)


def validity_text(validity: Validity) -> str:
    """Return in one sentence how long a calibration is valid."""
    limit = f"{validity.change_nm:g} nm RMS"
    if validity.days == 0:
        return f"From one calibration to the next the NCPAs change by more than {limit}."
    if _is_far(validity):
        at_least = min(validity.low_days, validity.seen_days)
        return f"The NCPAs stay within {limit} for at least {at_least:.3g} days: no drift to that is seen."
    return f"The NCPAs stay within {limit} for {validity.days:.3g} days ({_interval(validity)})."


def validity_number(validity: Validity) -> tuple[str, str]:
    """Return how long a calibration is valid in days, and what that means."""
    limit = f"within {validity.change_nm:g} nm RMS"
    if validity.days == 0:
        return "0 days", f"changes by more than {validity.change_nm:g} nm RMS at once"
    if _is_far(validity):
        return f"≥ {min(validity.low_days, validity.seen_days):.3g} days", f"{limit}; no drift to that seen"
    return f"{validity.days:.3g} days", f"{limit}; {_interval(validity)}"


def _is_far(validity: Validity) -> bool:
    """Whether the time is far beyond what the calibrations cover."""
    return validity.days > FAR * validity.seen_days


def _interval(validity: Validity) -> str:
    known = validity.high_days < float("inf")
    return f"95 %: {validity.low_days:.3g} {f'to {validity.high_days:.3g}' if known else 'or more'}"


def trend_json(trend: Trend) -> str:
    """Return all points, bands, verdicts and alarms as JSON."""
    return json_text(
        {
            "schema": "irlos-trend",
            "schema_version": 1,
            "series": list(map(_series, trend.series)),
            "wavefronts": [
                {"run": one.point.run, "night": one.point.night, **asdict(one.test)}
                for one in trend.wavefronts
            ],
            "stability": [
                {"recipe": recipe, "configuration": configuration, **asdict(structure)}
                | {"valid": asdict(trend.validities[recipe, configuration])}
                for (recipe, configuration), structure in trend.structures.items()
            ],
            "verdicts": [asdict(one) for one in trend.verdicts],
            "alarms": [alarm_text(*alarm) for alarm in trend.alarms(trend.last_night)],
        }
    ).rstrip()


def trend_csv(trend: Trend) -> str:
    """Return every point with what was expected of it as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(POINT_COLUMNS)
    for series in trend.series:
        out = {point.run for point, _ in series.alarms}
        for point, band in zip(series.points, series.bands, strict=True):
            sigma = "" if point.sigma is None else point.sigma
            low, high = (band.low, band.high) if band else ("", "")
            head = (point.name, point.recipe, point.configuration, point.night, point.run)
            writer.writerow((*head, point.unix_s, point.value, sigma, low, high, int(point.run in out)))
    return text.getvalue()


def alarms_line(trend: Trend) -> str:
    """Return one line on the alarms of the last night; "" without one."""
    found = [alarm_text(*alarm) for alarm in trend.alarms(trend.last_night)]
    return f"{plural(len(found), 'number')} out of band: {found[0]}{and_more(found)}" if found else ""


def _owner(series: Series) -> tuple[str, str]:
    return series.recipe, series.configuration


def _numbers_text(
    recipe: str, configuration: str, members: Sequence[Series], trend: Trend, everything: bool
) -> str:
    last = max(one.points[-1].night for one in members)
    title = f"{recipe}, last night {last}" + (f" ({configuration})" if configuration else "")
    shown = [one for one in members if everything or not _is_quiet_mode(one)]
    rows = [_row(one, last) for one in shown]
    lines = [title, aligned([COLUMNS, *rows])] if rows else [title]
    if hidden := len(members) - len(shown):
        lines.append(f"{hidden} of {sum(map(_is_mode, members))} modes are as expected (--all lists them)")
    own = [one for one in trend.wavefronts if _owner_of(one) == (recipe, configuration)]
    lines += _wavefront_lines(own)
    return "\n".join(lines)


def _owner_of(one: Wavefront) -> tuple[str, str]:
    return one.point.recipe, one.point.configuration


def _wavefront_lines(found: Sequence[Wavefront]) -> Iterator[str]:
    for one in found[-1:]:
        alarm = "" if one.test.holds(0.0) else "  ALARM"
        yield f"all modes: {one.test.text(one.point.value)}{alarm}"


def _is_mode(series: Series) -> bool:
    return series.name.startswith("noll_")


def _is_quiet_mode(series: Series) -> bool:
    return _is_mode(series) and not _alarms_now(series)


def _alarms_now(series: Series) -> bool:
    return any(point.run == series.points[-1].run for point, _ in series.alarms)


def _row(series: Series, night: str) -> tuple[str, ...]:
    last, band = series.points[-1], series.bands[-1]
    expected = f"{band.low:.4g} to {band.high:.4g}" if band else "too few nights"
    if series.name in OF_THE_SKY and band is None:
        expected = ""
    remarks = ["ALARM"] if _alarms_now(series) else []
    remarks += [f"of {last.night}"] if last.night != night else []
    return (
        series.name,
        f"{last.value:.4g}",
        number(last.sigma, ".2g"),
        expected,
        str(len({point.night for point in series.points})),
        " ".join(remarks),
    )


def _structure_rows(structure: Structure) -> Iterator[tuple[str, ...]]:
    columns = (
        structure.lag_s / DAY_S, structure.change_nm, structure.low_nm, structure.high_nm,
        structure.noise_nm2**0.5, structure.pairs,
    )  # fmt: skip
    for days, change, low, high, noise, pairs in zip(*columns, strict=True):
        yield f"{days:.3g}", f"{change:.2f}", f"{low:.1f} to {high:.1f}", f"{noise:.2f}", str(pairs)


def _series(series: Series) -> dict[str, Any]:
    points = [_point(point, band) for point, band in zip(series.points, series.bands, strict=True)]
    return {
        "name": series.name,
        "recipe": series.recipe,
        "configuration": series.configuration,
        "limits": series.limits and [series.limits.low, series.limits.high],
        "points": points,
    }


def _point(point: Point, band: Band | None) -> dict[str, Any]:
    return {
        "run": point.run,
        "night": point.night,
        "unix_s": point.unix_s,
        "value": point.value,
        "sigma": point.sigma,
        "band": band and [band.low, band.high],
    }


def label(name: str) -> str:
    """Return the name of a number as a label, with its unit in brackets."""
    plain, _, unit = name.rpartition("_")
    if unit not in UNITS:
        return name.replace("_", " ")
    words = [SPELLING.get(word, word) for word in plain.split("_")]
    return f"{' '.join(words)} [{unit}]"
