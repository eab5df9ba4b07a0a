"""What `irlos trend` tells on the terminal."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.files.json import json_text
from irlos_pipe.night.stability import DAY_S, Band, Structure
from irlos_pipe.night.trend import Series, Trend, alarm_text
from irlos_pipe.night.trend_db import Point
from irlos_pipe.report.text import number, plural

SERIES_COLUMNS = ("number", "recipe", "night", "value", "±", "band", "nights", "", "configuration")
STRUCTURE_COLUMNS = ("lag [days]", "change [nm RMS]", "noise alone [nm RMS]", "pairs")
VERDICT_COLUMNS = ("night", "group", "verdict", "effects")


def trend_text(trend: Trend) -> str:
    """Return the last value of every number with its band, the stability of the NCPAs, and the verdicts."""
    several = len({one.configuration for one in trend.series}) > 1
    rows = [SERIES_COLUMNS, *map(_series_row, trend.series)]
    parts = [aligned(rows if several else [row[:-1] for row in rows])]
    for (recipe, configuration), structure in trend.structures.items():
        title = f"Stability of the NCPAs, Noll 4 and up, {recipe} ({configuration}):"
        parts.append(f"{title}\n{aligned([STRUCTURE_COLUMNS, *_structure_rows(structure)])}")
    verdicts = [(one.night, one.group, one.verdict, ", ".join(one.effects)) for one in trend.verdicts]
    if verdicts:
        parts.append("What the model lacks:\n" + aligned([VERDICT_COLUMNS, *verdicts]))
    return "\n\n".join(parts)


def trend_json(trend: Trend) -> str:
    """Return everything for scripts."""
    told = {
        "schema": "irlos-trend",
        "schema_version": 1,
        "series": list(map(_series, trend.series)),
        "stability": [
            {"recipe": recipe, "configuration": configuration, **asdict(structure)}
            for (recipe, configuration), structure in trend.structures.items()
        ],
        "verdicts": [asdict(one) for one in trend.verdicts],
        "alarms": [alarm_text(*alarm) for alarm in trend.alarms(trend.last_night)],
    }
    return json_text(told).rstrip()


def alarms_line(trend: Trend) -> str:
    """Return one line on the alarms of the last night; nothing without one."""
    found = [alarm_text(*alarm) for alarm in trend.alarms(trend.last_night)]
    return f"{plural(len(found), 'number')} out of band: {found[0]}{and_more(found)}" if found else ""


def _series_row(series: Series) -> tuple[str, ...]:
    last, band = series.points[-1], series.bands[-1]
    out = any(point.run == last.run for point, _ in series.alarms)
    shown = f"{band.low:.4g} to {band.high:.4g}" if band else "too few nights"
    return (
        series.name,
        series.recipe,
        last.night,
        f"{last.value:.4g}",
        number(last.sigma, ".2g"),
        shown,
        str(len({point.night for point in series.points})),
        "ALARM" if out else "",
        series.configuration,
    )


def _structure_rows(structure: Structure) -> list[tuple[str, ...]]:
    columns = (structure.lag_s / DAY_S, structure.change_nm, structure.noise_nm2**0.5, structure.pairs)
    return [
        (f"{lag_days:.3g}", f"{change:.2f}", f"{noise:.2f}", str(pairs))
        for lag_days, change, noise, pairs in zip(*columns, strict=True)
    ]


def _series(series: Series) -> dict[str, Any]:
    points = [_point(point, band) for point, band in zip(series.points, series.bands, strict=True)]
    return {
        "name": series.name,
        "recipe": series.recipe,
        "configuration": series.configuration,
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
