"""Numbers from night to night: their series, the alarms, and the stability of the NCPAs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, NothingToDo
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.night.database import Point, Verdict, existing
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.trend_statistics import Band, Structure, bands, structure_function

TIP_TILT = ("noll_2_nm", "noll_3_nm")  # the position of the star, not the instrument
# Numbers that depend on the sky are followed but do not alarm.
OF_THE_SKY = ("seeing_arcsec", "ao_residual_nm", "jitter_mas", "ncpa_nm", "ramp_error_nm", *TIP_TILT)


@dataclass(frozen=True)
class Series:
    """One number of one recipe and one configuration in order of time.

    Attributes
    ----------
    bands : tuple of Band or None
        Band of every point, from the nights before it; None where these are too few.
    """

    name: str
    recipe: str
    configuration: str
    points: tuple[Point, ...]
    bands: tuple[Band | None, ...]

    @property
    def alarms(self) -> list[tuple[Point, Band]]:
        """The points out of their bands, with these; none for a number that depends on the sky."""
        if self.name in OF_THE_SKY:
            return []
        pairs = zip(self.points, self.bands, strict=True)
        return [(point, band) for point, band in pairs if band and not band.holds(point.value)]

    def until(self, night: str) -> Series | None:
        """Return the series as it was after a night; None when it had no point."""
        count = sum(point.night <= night for point in self.points)
        return replace(self, points=self.points[:count], bands=self.bands[:count]) if count else None


@dataclass(frozen=True)
class Trend:
    """All series, the structure function of the NCPAs by recipe and configuration, and the verdicts."""

    series: tuple[Series, ...]
    structures: dict[tuple[str, str], Structure]
    verdicts: tuple[Verdict, ...]

    def alarms(self, night: str = "") -> list[tuple[Point, Band]]:
        """Return the points out of their bands, of one night or of all (empty date)."""
        found = [alarm for series in self.series for alarm in series.alarms]
        return [alarm for alarm in found if not night or alarm[0].night == night]

    def until(self, night: str) -> Trend:
        """Return the trend as it was after a night."""
        series = tuple(filter(None, (one.until(night) for one in self.series)))
        return Trend(series, _structures(series), tuple(one for one in self.verdicts if one.night <= night))

    @property
    def last_night(self) -> str:
        """The latest night with a number; "" without one."""
        return max((series.points[-1].night for series in self.series), default="")


def read_trend(tree: Path, rule: BandSettings, names: Sequence[str] = (), until: str = "") -> Trend:
    """Read the trend of a tree of nights.

    Parameters
    ----------
    tree : Path
        Folder of all results.
    rule : BandSettings
        When a number counts as out of its band.
    names : sequence of str
        Numbers to keep, without verdicts then; all if empty.
    until : str
        Last night, ISO date; all if empty.

    Raises
    ------
    InputDataError, NothingToDo
        When it is no such tree, or has no numbers.
    ConfigurationError
        When a name is unknown.
    """
    with existing(tree) as database:
        trend = make_trend(database.points(until), database.verdicts(until), rule)
    if not trend.series:
        raise NothingToDo(f"{tree}: no numbers yet" + (f" until {until}" if until else ""))
    known = sorted({one.name for one in trend.series}, key=_natural)
    for name in names:
        if name not in known:
            raise ConfigurationError(f"--of {name}: no such number{suggestion(name, known)}")
    if not names:
        return trend
    return replace(trend, series=tuple(one for one in trend.series if one.name in names), verdicts=())


def make_trend(points: Sequence[Point], verdicts: Sequence[Verdict], rule: BandSettings) -> Trend:
    """Sort points into series with their bands.

    Parameters
    ----------
    points, verdicts : sequence of Point, sequence of Verdict
        In order of time.
    rule : BandSettings
        When a number counts as out of its band.
    """
    parts = groupby(sorted(points, key=_owner), _owner)
    series = tuple(_series(tuple(members), rule) for _, members in parts)
    return Trend(series, _structures(series), tuple(verdicts))


def alarm_text(point: Point, band: Band) -> str:
    """Return one line on a `point` that left its `band`."""
    return (
        f"{point.run}: {point.name} = {point.value:.4g} outside {band.low:.4g} to {band.high:.4g} "
        f"({band.nights} earlier nights)"
    )


def _series(members: tuple[Point, ...], rule: BandSettings) -> Series:
    found = bands(
        [one.night for one in members], [one.value for one in members], [one.sigma for one in members], rule
    )
    first = members[0]
    return Series(first.name, first.recipe, first.configuration, members, tuple(found))


def _structures(series: Sequence[Series]) -> dict[tuple[str, str], Structure]:
    owners = dict.fromkeys((one.recipe, one.configuration) for one in series if _noll(one.name))
    return {who: found for who in owners if (found := _structure(series, *who)) is not None}


def _structure(series: Sequence[Series], recipe: str, configuration: str) -> Structure | None:
    """Structure function of the modes that all runs of a recipe have, without tip and tilt."""
    modes = {
        one.name: {point.run: point for point in one.points}
        for one in series
        if (one.recipe, one.configuration) == (recipe, configuration)
        and _noll(one.name)
        and one.name not in TIP_TILT
    }
    if not modes:
        return None
    common = set.intersection(*(set(runs) for runs in modes.values()))
    rows = [[runs[run] for runs in modes.values()] for run in common]
    rows.sort(key=lambda row: row[0].unix_s)
    if len(rows) < 2:
        return None
    value = np.array([[one.value for one in row] for row in rows])
    sigma = np.array([[one.sigma or 0.0 for one in row] for row in rows])
    return structure_function(np.array([row[0].unix_s for row in rows]), value, sigma)


def _owner(one: Point) -> tuple[Any, ...]:
    """What the points of a series have in common; sorts Noll modes by index."""
    return (*_natural(one.name), one.recipe, one.configuration)


def _noll(name: str) -> bool:
    return name.startswith("noll_")


def _natural(name: str) -> tuple[str, int]:
    """Order of names: Noll modes first, by number."""
    return ("", int(name.split("_")[1])) if _noll(name) else (name, 0)
