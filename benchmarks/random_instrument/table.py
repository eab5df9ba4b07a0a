"""Medians, rates and pulls with their intervals as tables, and their place in docs/random_instrument.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from benchmarks.diagnose_suite.rates import Rate
from benchmarks.pages import put
from benchmarks.random_instrument.cases import SEEINGS_ARCSEC
from benchmarks.random_instrument.scoring import BAD_NM, BAD_PULL, Judged, judged

PAGE = Path(__file__).parents[2] / "docs" / "random_instrument.md"
CONFIDENCE, RESAMPLES, SEED = 0.95, 2000, 1
Statistic = Callable[..., np.ndarray]
Outcome = Mapping[str, Any]


def tables(outcomes: Sequence[Outcome]) -> str:
    """Return what came of the `outcomes`: together, by seeing, and one by one where they were diagnosed."""
    both = [one for one in outcomes if one["diagnosed"]]
    columns = {
        f"as told, {len(outcomes)} draws": _all(outcomes, "plain"),
        f"as told, the {len(both)} diagnosed": _all(both, "plain"),
        f"with `diagnose`, {len(both)} draws": _all(both, "diagnosed"),
    }
    return "\n\n".join([_table(columns), _by_seeing(outcomes), _one_by_one(both)])


def _all(outcomes: Sequence[Outcome], which: str) -> list[Judged]:
    return [judged(one, which) for one in outcomes]


def _table(columns: Mapping[str, Sequence[Judged]]) -> str:
    rows: dict[str, tuple[str, Callable[[Sequence[Judged]], str]]] = {
        "error of Noll 2–30, median": ("≤ 5 nm", lambda some: median_text([one.error_nm for one in some])),
        "… 90 % are below": ("12 nm", lambda some: _text([one.error_nm for one in some], _ninth, " nm")),
        "… of Noll 4–30, median": ("", lambda some: median_text([one.shape_nm for one in some])),
        "… with the error of the diversity, median": (
            "",
            lambda some: median_text([one.strict_nm for one in some]),
        ),
        "error of the defocus, RMS": ("", lambda some: _text([one.defocus_nm for one in some], _rms, " nm")),
        "pull of Noll 4–30, RMS": ("0.7–1.5", lambda some: _text([one.pull for one in some], _rms)),
        "pull of a draw, median": ("", lambda some: _text([one.pull for one in some], np.median)),
        f"bad: above {BAD_NM:g} nm, or pull above {BAD_PULL:g}": (
            "",
            lambda some: _rate(one.bad for one in some),
        ),
        "red light: the run ends with exit code 4": ("", lambda some: _rate(one.red for one in some)),
        "… where bad": ("", lambda some: _rate(one.red for one in some if one.bad)),
        "… where good": ("", lambda some: _rate(one.red for one in some if not one.bad)),
        "the light is right": ("", lambda some: _rate(one.red == one.bad for one in some)),
    }
    lines = [_line("", "asked with `diagnose`", *columns), "|---" * (2 + len(columns)) + "|"]
    lines += [_line(what, asked, *map(text, columns.values())) for what, (asked, text) in rows.items()]
    return "\n".join(lines)


def _by_seeing(outcomes: Sequence[Outcome]) -> str:
    lines = [
        _line("seeing", "calibration", "draws", "error, median", "pull, RMS", "bad", "red"),
        "|---" * 7 + "|",
    ]
    for seeing in SEEINGS_ARCSEC:
        for which, name in (("plain", "as told"), ("diagnosed", "with `diagnose`")):
            some = _all([one for one in outcomes if one["seeing_arcsec"] == seeing and one[which]], which)
            cells = [
                median_text([one.error_nm for one in some]),
                _text([one.pull for one in some], _rms),
                str(sum(one.bad for one in some)),
                str(sum(one.red for one in some)),
            ]
            lines.append(_line(f"{seeing:g}″", name, str(len(some)), *cells))
    return "\n".join(lines)


def _one_by_one(outcomes: Sequence[Outcome]) -> str:
    head = ("draw", "seeing", "residual", "error", "pull", "light", "names, grade")
    lines = [_line(*head), "|---" * len(head) + "|"]
    for one in outcomes:
        before, after = judged(one, "plain"), judged(one, "diagnosed")
        found = one["diagnosed"]
        cells = [
            f"{before.error_nm:.1f} → {after.error_nm:.1f} nm",
            f"{before.pull:.1f} → {after.pull:.1f}",
            " → ".join("red" if each.red else "green" for each in (before, after)),
            f"{', '.join(found['names']) or 'none'}; {found['grade']}",
        ]
        law = one["shape"].replace("_", " ")
        lines.append(_line(str(one["index"]), f"{one['seeing_arcsec']:g}″", law, *cells))
    return "\n".join(lines)


def _line(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def median_text(values_nm: Sequence[float]) -> str:
    """Return the median of `values_nm` with its interval."""
    return _text(values_nm, np.median, " nm")


def _text(values: Sequence[float], statistic: Statistic, unit: str = "") -> str:
    """A statistic with its interval over draws of the cases."""
    if not values:
        return "-"
    value = float(statistic(np.array(values), axis=-1))
    low, high = interval(values, statistic)
    digits = 1 if unit else 2
    return f"{value:.{digits}f}{unit} ({low:.{digits}f}–{high:.{digits}f})"


def interval(values: Sequence[float], statistic: Statistic) -> tuple[float, float]:
    """Return the bootstrap interval of 95 % (percentiles) of a `statistic`; of one value, the value."""
    if len(values) < 2:
        return values[0], values[0]
    found = bootstrap(
        (np.array(values),),
        statistic,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    ).confidence_interval
    return float(found.low), float(found.high)


def _rms(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=axis))


def _ninth(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.percentile(values, 90, axis=axis)


def _rate(events: Any) -> str:
    rate = Rate.of(events)
    return (
        f"{rate.count} of {rate.total} ({100 * rate.low:.0f}–{100 * rate.high:.0f} %)" if rate.total else "-"
    )


def write_page(text: str) -> None:
    """Put the tables between their marks in docs/random_instrument.md."""
    put(PAGE, {"random instrument": text})
