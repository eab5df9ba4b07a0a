"""Numbers from night to night: one table of all of them, the alarms, and the stability of the NCPAs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, NothingToDo
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.night import bands
from irlos_pipe.night.database import Verdict, existing
from irlos_pipe.night.settings import BandSettings, Limits
from irlos_pipe.night.stability import Structure, Validity, structure_function, with_confidence

TIP_TILT = ("noll_2_nm", "noll_3_nm")  # the position of the star, not the instrument
# Numbers that depend on the sky are followed but do not alarm.
OF_THE_SKY = (
    "seeing_arcsec", "ao_residual_nm", "jitter_mas", "ncpa_nm", "ramp_error_nm", "focus_2x2_nm", *TIP_TILT,
)  # fmt: skip
NEVER_NEGATIVE = (
    "seeing_arcsec", "ao_residual_nm", "jitter_mas", "ncpa_nm", "ramp_error_nm", "chi2_nu", "gap_before",
    "gap_after", "gap_floor",
)  # fmt: skip
WAVEFRONT = "wavefront_nm"  # all modes of a run against the nights before
UNITS = ("nm", "arcsec", "mas")
SPELLING = {"noll": "Noll", "ncpa": "NCPAs", "ao": "AO"}
Owner = tuple[str, str]  # recipe, configuration


@dataclass(frozen=True)
class Series:
    """One number of one recipe and one configuration in order of time, and the limits it is given."""

    points: tuple[bands.Point, ...]
    limits: Limits | None = None

    @property
    def name(self) -> str:
        return self.last.name

    @property
    def owner(self) -> Owner:
        return self.last.recipe, self.last.configuration

    @property
    def last(self) -> bands.Point:
        return self.points[-1]

    @property
    def alarms(self) -> bool:
        return any(one.alarm for one in self.points)


@dataclass(frozen=True)
class Trend:
    """What the nights of a tree show."""

    points: tuple[bands.Point, ...] = ()  # all numbers, series after series, in order of time
    # Every calibration with enough nights before it, in order of time: the modes from Noll 4 together, as the
    # RMS change, and the test of it.
    wavefronts: tuple[tuple[bands.Point, bands.WavefrontTest], ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    rule: BandSettings = field(default_factory=BandSettings)
    names: tuple[str, ...] = ()  # numbers to show; all if empty

    @cached_property
    def series(self) -> tuple[Series, ...]:
        limits = self.rule.limits
        found = (Series(tuple(members), limits.get(key[0])) for key, members in groupby(self.points, _key))
        return tuple(one for one in found if not self.names or one.name in self.names)

    @cached_property
    def stabilities(self) -> dict[Owner, tuple[Structure, Validity]]:
        """Structure function of the NCPAs, and how long they hold, by recipe and configuration."""
        modes: dict[Owner, list[list[bands.Point]]] = {}
        for (name, *owner), members in groupby(self.points, _key):
            if is_mode(name):
                found = modes.setdefault((owner[0], owner[1]), [])
                found += [] if name in TIP_TILT else [list(members)]
        known = {owner: _stability(points, self.rule) for owner, points in modes.items() if points}
        return {owner: one for owner, one in known.items() if one is not None}

    def alarms(self, night: str = "") -> list[str]:
        """Return one line on all that is not as expected, of one `night` or of all; wavefronts first."""
        shown = [point for series in self.series for point in series.points]
        return [
            f"{one.run}: {one.name} = {one.alarm}"
            for one in (*(point for point, _ in self.wavefronts), *shown)
            if one.alarm and (not night or one.night == night)
        ]

    def until(self, night: str) -> "Trend":
        return replace(
            self,
            points=tuple(one for one in self.points if one.night <= night),
            wavefronts=tuple(one for one in self.wavefronts if one[0].night <= night),
            verdicts=tuple(one for one in self.verdicts if one.night <= night),
        )

    @property
    def last_night(self) -> str:
        return max((series.last.night for series in self.series), default="")


def read_trend(tree: Path, rule: BandSettings, names: Sequence[str] = (), until: str = "") -> Trend:
    """Read the trend of a `tree` of nights up to the night `until`, an ISO date; of all if that is empty.

    The `rule` says when a number counts as out of its band. If `names` of numbers are given, only these are
    shown, without verdicts.

    Raises `InputDataError` or `NothingToDo` when it is no such tree, or has no numbers; `ConfigurationError`
    when a name is unknown.
    """
    with existing(tree) as database:
        trend = make_trend(database.points(), database.verdicts(), rule)
    if until:
        trend = trend.until(until)
    if not trend.points:
        raise NothingToDo(f"{tree}: no numbers yet" + (f" until {until}" if until else ""))
    known = sorted({one.name for one in trend.points}, key=_natural)
    for name in names:
        if name not in known:
            raise ConfigurationError(f"--of {name}: no such number{suggestion(name, known)}")
    return replace(trend, names=tuple(names), verdicts=(), wavefronts=()) if names else trend


def make_trend(points: Sequence[bands.Point], verdicts: Sequence[Verdict], rule: BandSettings) -> Trend:
    """Give `points` their bands and alarms by the `rule`; they and `verdicts` are in order of time."""
    ordered = sorted(points, key=lambda one: (*_natural(one.name), *_owner(one)))
    before = {key: bands.histories(list(members), rule.nights) for key, members in groupby(ordered, _key)}
    excess = _excesses(before)
    judged = [_judged(one, before[_key(one)][one.night], excess, rule) for one in ordered]
    return Trend(tuple(judged), tuple(_wavefronts(judged, rule)), tuple(verdicts), rule)


def _excesses(before: Mapping[tuple[str, ...], Mapping[str, bands.History]]) -> dict[tuple[str, ...], float]:
    """By how much the modes scatter beyond their errors, by recipe, configuration and night."""
    modes: dict[tuple[str, ...], list[bands.History]] = {}
    for (name, *owner), by_night in before.items():
        if is_mode(name) and name not in TIP_TILT:
            for night, history in by_night.items():
                modes.setdefault((*owner, night), []).append(history)
    return {
        who: bands.excess_scatter([one for one in found if len(one.medians) == len(found[0].medians)])
        for who, found in modes.items()
    }


def _judged(
    one: bands.Point, before: bands.History, excess: Mapping[tuple[str, ...], float], rule: BandSettings
) -> bands.Point:
    """The point with its band, and with what is said of it beyond its limits or band."""
    lowest = 0.0 if one.name in NEVER_NEGATIVE else -np.inf
    own = excess.get((*_owner(one), one.night)) if _of_wavefront(one) else None
    band = bands.band_of(before, one.sigma, rule, own, lowest)
    alarm = _beyond(one.value, rule.limits.get(one.name, (None, None)))
    if not alarm and band and one.name not in OF_THE_SKY and not band.holds(one.value):
        alarm = f"{one.value:.4g} outside {band.low:.4g} to {band.high:.4g} ({band.nights} earlier nights)"
    return replace(one, band=band, alarm=alarm)


def _beyond(value: float, limits: Limits) -> str:
    """What is said of a value outside the limits of the configuration."""
    low, high = limits
    if (low is None or value >= low) and (high is None or value <= high):
        return ""
    begin, end = "" if low is None else f"{low:g} ", "" if high is None else f"{high:g}"
    return f"{value:.4g} outside the limits {begin}to {end}"


def _wavefronts(
    points: Sequence[bands.Point], rule: BandSettings
) -> list[tuple[bands.Point, bands.WavefrontTest]]:
    """Every calibration with the bands of its modes, in order of time."""
    runs: dict[str, list[tuple[bands.Point, bands.Band]]] = {}
    for one in filter(_of_wavefront, points):
        if one.band and one.sigma is not None:
            runs.setdefault(one.run, []).append((one, one.band))
    found = []
    for members in runs.values():
        if len(members) > 1:
            modes, found_bands = zip(*members, strict=True)
            test = bands.wavefront_test([one.value for one in modes], found_bands, rule)
            whole = replace(modes[0], name=WAVEFRONT, value=test.change_nm, sigma=None, band=None)
            found.append((replace(whole, alarm="" if test.holds else str(test)), test))
    return sorted(found, key=lambda one: (one[0].unix_s, one[0].run))


def _stability(
    modes: Sequence[Sequence[bands.Point]], rule: BandSettings
) -> tuple[Structure, Validity] | None:
    """Structure function of the modes that all runs of a recipe have, without tip and tilt."""
    by_run = [{point.run: point for point in points} for points in modes]
    common = set.intersection(*map(set, by_run))
    rows = sorted(([runs[run] for runs in by_run] for run in common), key=lambda row: row[0].unix_s)
    if len(rows) < 2:
        return None
    times = np.array([row[0].unix_s for row in rows])
    value = np.array([[one.value for one in row] for row in rows])
    sigma = np.array([[one.sigma or 0.0 for one in row] for row in rows])
    found = structure_function(times, value, sigma)
    return with_confidence(found, times, value, sigma, rule.valid_change_nm) if len(found.pairs) else None


def _key(one: bands.Point) -> tuple[str, ...]:
    """What the points of a series have in common."""
    return one.name, *_owner(one)


def _owner(one: bands.Point) -> Owner:
    return one.recipe, one.configuration


def is_mode(name: str) -> bool:
    """Whether a number is a Zernike coefficient."""
    return name.startswith("noll_")


def label(name: str) -> str:
    """Return the name of a number as a label, with its unit in brackets."""
    plain, _, unit = name.rpartition("_")
    if unit not in UNITS:
        return name.replace("_", " ")
    words = [SPELLING.get(word, word) for word in plain.split("_")]
    return f"{' '.join(words)} [{unit}]"


def _of_wavefront(one: bands.Point) -> bool:
    return is_mode(one.name) and one.name not in TIP_TILT


def _natural(name: str) -> tuple[str, int]:
    """Order of names: Noll modes first, by number."""
    return ("", int(name.split("_")[1])) if is_mode(name) else (name, 0)
