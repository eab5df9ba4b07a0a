"""Numbers from night to night: their series, the alarms, and the stability of the NCPAs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, NothingToDo
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.night.bands import (
    Band,
    History,
    WavefrontTest,
    band_of,
    excess_scatter,
    histories,
    wavefront_test,
)
from irlos_pipe.night.database import Point, Verdict, existing
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.stability import Structure, Validity, structure_function, with_confidence

TIP_TILT = ("noll_2_nm", "noll_3_nm")  # the position of the star, not the instrument
# Numbers that depend on the sky are followed but do not alarm.
OF_THE_SKY = (
    "seeing_arcsec",
    "ao_residual_nm",
    "jitter_mas",
    "ncpa_nm",
    "ramp_error_nm",
    "focus_2x2_nm",
    *TIP_TILT,
)
NEVER_NEGATIVE = (
    "seeing_arcsec", "ao_residual_nm", "jitter_mas", "ncpa_nm", "ramp_error_nm", "chi2_nu", "gap_before",
    "gap_after", "gap_floor",
)  # fmt: skip
WAVEFRONT = "wavefront_nm"  # all modes of a run against the nights before


class Expected(Protocol):
    """What a number is held against."""

    def holds(self, value: float) -> bool:
        """Whether a value is as expected."""

    def text(self, value: float) -> str:
        """Return what is said of a value that is not."""


@dataclass(frozen=True)
class Limits:
    """The range that the configuration gives a number; None for no limit."""

    low: float | None
    high: float | None

    def holds(self, value: float) -> bool:
        """Whether a value lies within."""
        return not (
            (self.low is not None and value < self.low) or (self.high is not None and value > self.high)
        )

    def text(self, value: float) -> str:
        """Return what is said of a `value` outside."""
        low = "" if self.low is None else f"{self.low:g} "
        return f"{value:.4g} outside the limits {low}to {'' if self.high is None else format(self.high, 'g')}"


Alarm = tuple[Point, Expected]
Key = tuple[str, str, str]  # name, recipe, configuration


@dataclass(frozen=True)
class Series:
    """One number of one recipe and one configuration in order of time.

    Attributes
    ----------
    bands : tuple of Band or None
        Band of every point, from the nights before it; None where these are too few.
    limits : Limits or None
        Of the configuration.
    """

    name: str
    recipe: str
    configuration: str
    points: tuple[Point, ...]
    bands: tuple[Band | None, ...]
    limits: Limits | None = None

    @property
    def alarms(self) -> list[Alarm]:
        """The points out of their limits or bands; a number that depends on the sky has only limits."""
        found: list[Alarm] = []
        for point, band in zip(self.points, self.bands, strict=True):
            expected: tuple[Expected | None, ...] = (self.limits, None if self.name in OF_THE_SKY else band)
            wrong = next((one for one in expected if one and not one.holds(point.value)), None)
            found += [(point, wrong)] if wrong else []
        return found

    def until(self, night: str) -> Series | None:
        """Return the series as it was after a night; None when it had no point."""
        count = sum(point.night <= night for point in self.points)
        return replace(self, points=self.points[:count], bands=self.bands[:count]) if count else None


@dataclass(frozen=True)
class Wavefront:
    """The modes of a run, Noll 4 and up, together: a point with the RMS change, and the test of it."""

    point: Point
    test: WavefrontTest


@dataclass(frozen=True)
class Trend:
    """What the nights of a tree show.

    Attributes
    ----------
    structures : dict
        Structure function of the NCPAs by recipe and configuration; `validities` say how long they hold.
    wavefronts : tuple of Wavefront
        Every calibration with enough nights before it, in order of time.
    """

    series: tuple[Series, ...]
    structures: dict[tuple[str, str], Structure]
    verdicts: tuple[Verdict, ...]
    wavefronts: tuple[Wavefront, ...] = ()
    validities: Mapping[tuple[str, str], Validity] = field(default_factory=dict)
    rule: BandSettings = field(default_factory=BandSettings)

    def alarms(self, night: str = "") -> list[Alarm]:
        """Return what is not as expected, of one night or of all (empty date); whole wavefronts first."""
        whole: list[Alarm] = [(one.point, one.test) for one in self.wavefronts if not one.test.holds(0.0)]
        found = whole + [alarm for series in self.series for alarm in series.alarms]
        return [alarm for alarm in found if not night or alarm[0].night == night]

    def until(self, night: str) -> Trend:
        """Return the trend as it was after a night."""
        series = tuple(filter(None, (one.until(night) for one in self.series)))
        return _assembled(
            series,
            tuple(one for one in self.verdicts if one.night <= night),
            tuple(one for one in self.wavefronts if one.point.night <= night),
            self.rule,
        )

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
    chosen = tuple(one for one in trend.series if one.name in names)
    return replace(trend, series=chosen, verdicts=(), wavefronts=())


def make_trend(points: Sequence[Point], verdicts: Sequence[Verdict], rule: BandSettings) -> Trend:
    """Sort points into series with their bands.

    Parameters
    ----------
    points, verdicts : sequence of Point, sequence of Verdict
        In order of time.
    rule : BandSettings
        When a number counts as out of its band.
    """
    parts = [tuple(members) for _, members in groupby(sorted(points, key=_owner), _owner)]
    before = {_key(members[0]): _histories(members, rule) for members in parts}
    excess = _excesses(before)
    series = tuple(_series(members, before[_key(members[0])], excess, rule) for members in parts)
    return _assembled(series, tuple(verdicts), _wavefronts(series, rule), rule)


def alarm_text(point: Point, expected: Expected) -> str:
    """Return one line on a `point` that is not as `expected`."""
    return f"{point.run}: {point.name} = {expected.text(point.value)}"


def _assembled(
    series: tuple[Series, ...],
    verdicts: tuple[Verdict, ...],
    wavefronts: tuple[Wavefront, ...],
    rule: BandSettings,
) -> Trend:
    found = dict(_stabilities(series, rule))
    structures = {who: structure for who, (structure, _) in found.items()}
    validities = {who: validity for who, (_, validity) in found.items()}
    return Trend(series, structures, verdicts, wavefronts, validities, rule)


def _histories(members: Sequence[Point], rule: BandSettings) -> dict[str, History]:
    columns = zip(*((one.night, one.value, one.sigma) for one in members), strict=True)
    nights, values, sigmas = (list(column) for column in columns)
    return histories(nights, values, sigmas, rule.nights)


def _excesses(before: Mapping[Key, Mapping[str, History]]) -> dict[tuple[str, str, str], float]:
    """By how much the modes scatter beyond their errors, by recipe, configuration and night."""
    modes: dict[tuple[str, str, str], list[History]] = {}
    for (name, recipe, configuration), by_night in before.items():
        if _of_wavefront(name):
            for night, history in by_night.items():
                modes.setdefault((recipe, configuration, night), []).append(history)
    return {
        who: excess_scatter([one for one in found if len(one.medians) == len(found[0].medians)])
        for who, found in modes.items()
    }


def _series(
    members: tuple[Point, ...],
    before: Mapping[str, History],
    excess: Mapping[tuple[str, str, str], float],
    rule: BandSettings,
) -> Series:
    name, recipe, configuration = _key(members[0])
    lowest = 0.0 if name in NEVER_NEGATIVE else -np.inf
    found = tuple(
        band_of(
            before[one.night],
            one.sigma,
            rule,
            excess.get((recipe, configuration, one.night)) if _of_wavefront(name) else None,
            lowest,
        )
        for one in members
    )
    limits = Limits(*rule.limits[name]) if name in rule.limits else None
    return Series(name, recipe, configuration, members, found, limits)


def _wavefronts(series: Sequence[Series], rule: BandSettings) -> tuple[Wavefront, ...]:
    """Every calibration with the bands of its modes, in order of time."""
    runs: dict[str, list[tuple[Point, Band]]] = {}
    for one in series:
        if _of_wavefront(one.name):
            for point, band in zip(one.points, one.bands, strict=True):
                if band and point.sigma is not None:
                    runs.setdefault(point.run, []).append((point, band))
    found = [_wavefront(members, rule) for members in runs.values() if len(members) > 1]
    return tuple(sorted(found, key=lambda one: (one.point.unix_s, one.point.run)))


def _wavefront(members: Sequence[tuple[Point, Band]], rule: BandSettings) -> Wavefront:
    test = wavefront_test([point.value for point, _ in members], [band for _, band in members], rule)
    return Wavefront(replace(members[0][0], name=WAVEFRONT, value=test.change_nm, sigma=None), test)


def _stabilities(
    series: Sequence[Series], rule: BandSettings
) -> Iterator[tuple[tuple[str, str], tuple[Structure, Validity]]]:
    for who in dict.fromkeys((one.recipe, one.configuration) for one in series if _noll(one.name)):
        found = _stability(series, *who, rule)
        if found is not None:
            yield who, found


def _stability(
    series: Sequence[Series], recipe: str, configuration: str, rule: BandSettings
) -> tuple[Structure, Validity] | None:
    """Structure function of the modes that all runs of a recipe have, without tip and tilt."""
    modes = {
        one.name: {point.run: point for point in one.points}
        for one in series
        if (one.recipe, one.configuration) == (recipe, configuration) and _of_wavefront(one.name)
    }
    if not modes:
        return None
    common = set.intersection(*(set(runs) for runs in modes.values()))
    rows = [[runs[run] for runs in modes.values()] for run in common]
    rows.sort(key=lambda row: row[0].unix_s)
    if len(rows) < 2:
        return None
    times = np.array([row[0].unix_s for row in rows])
    value = np.array([[one.value for one in row] for row in rows])
    sigma = np.array([[one.sigma or 0.0 for one in row] for row in rows])
    found = structure_function(times, value, sigma)
    return with_confidence(found, times, value, sigma, rule.valid_change_nm) if len(found.pairs) else None


def _key(one: Point) -> Key:
    return one.name, one.recipe, one.configuration


def _of_wavefront(name: str) -> bool:
    return _noll(name) and name not in TIP_TILT


def _owner(one: Point) -> tuple[Any, ...]:
    """What the points of a series have in common; sorts Noll modes by index."""
    return (*_natural(one.name), one.recipe, one.configuration)


def _noll(name: str) -> bool:
    return name.startswith("noll_")


def _natural(name: str) -> tuple[str, int]:
    """Order of names: Noll modes first, by number."""
    return ("", int(name.split("_")[1])) if _noll(name) else (name, 0)
