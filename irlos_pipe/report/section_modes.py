"""Section on the modes: how strong they are, and how many to estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.conventions.modes import REPORTED_TEXT
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error
from irlos_pipe.stages.modes import LawRow, ModesResults, NumberScan

STAGE = "modes"
SIZE_IN = (5.2, 3.6)
MARKERS = ("o", "s", "D", "^", "v", "P")
LAWS = {"estimates": "of the estimates", "ncpas": "without their errors"}
LAW_COLUMNS = ("law", "A [nm]", "B", "C [nm]", "deviance/ν", "plateau from Noll")
NUMBER_COLUMNS = (
    "Noll 2 to",
    "χ²/ν unseen",
    "above the least",
    "χ²/ν fitted",
    f"change in {REPORTED_TEXT} [nm]",
    "error from the halves [nm]",
)


def modes_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(ModesResults)
    blocks = [*_strength(run, results), Stack([law_table(results.laws, LAWS)]), *_numbers(results.numbers)]
    return Section(STAGE, "Strength and number of modes", _lead(results), blocks)


def _lead(results: ModesResults) -> str:
    draws = plural(results.draws, "draw")
    text = f"{results.method} on {plural(results.cubes, 'cube')}, each by itself; {draws}"
    single = ": enough for a law, not for the standard deviation of a single mode"
    rest = single if results.draws == 1 else ""
    return f"{text} of every mode{rest}."


def _strength(run: RunData, results: ModesResults) -> list[Figure]:
    noll, std, frames = (run.array(STAGE, name) for name in ("noll", "std_nm", "frame_std_nm"))
    if noll is None or std is None or frames is None:
        return []
    several = results.draws > 1
    label = "RMS over the cubes" if several else "|coefficient|"
    sigma = run.error_of(STAGE, "std_nm") if several else None
    points = {
        label: Points(noll, std, run.array(STAGE, "law/estimates_nm"), sigma),
        "over the frames of a cube": Points(noll, frames),
    }
    law = run.array(STAGE, "law/ncpas_nm")
    lines = {} if law is None else {"law without errors": np.stack([noll, law])}
    caption = (
        "Line: fitted law (tip and tilt left out). The scatter over frames is that of the AO residual "
        "and the noise; it says nothing about NCPAs."
    )
    return [Figure(strength_plot("modes-strength", points, lines), "Strength of the modes", caption)]


def law_table(laws: Mapping[str, LawRow], names: Mapping[str, str]) -> Table:
    """Tabulate fitted `laws`; `names` states what each was fitted to."""
    rows = [
        (
            names.get(name, name),
            with_error(law.A_nm, law.A_sigma_nm, ".1f"),
            with_error(law.B, law.B_sigma, ".3f"),
            with_error(law.C_nm, law.C_sigma_nm, ".1f"),
            number(law.deviance_nu, ".2f"),
            number(law.plateau_noll, "d"),
        )
        for name, law in laws.items()
    ]
    caption = (
        "std(i) = A exp(−B i) + C, i = 0 for Noll 2; maximum likelihood. The plateau begins where the "
        "exponential is a tenth of C."
    )
    return Table(LAW_COLUMNS, rows, "Law of the standard deviation", caption)


def _numbers(numbers: NumberScan | None) -> list[Figure | Stack]:
    if numbers is None:
        return []
    highest, excess, sigma = numbers.highest_noll, np.array(numbers.excess), np.array(numbers.excess_sigma)
    change = np.array(numbers.change_nm)
    curves = {
        "change from the recommended number": np.where(change > 0, change, np.nan),
        "error from the difference of the halves": np.array(numbers.halves_nm),
    }
    recommended = numbers.recommended
    return [
        Figure(
            misfit_plot("modes-misfit", highest, excess, sigma, recommended),
            "Frames that no fit has seen",
            f"One half of the frames fitted, the other predicted. Dotted: Noll 2–{recommended}, the fewest "
            "modes that predict them as well as any, within the error.",
        ),
        Figure(
            error_plot("modes-change", highest, curves, f"RMS in {REPORTED_TEXT} [nm]", recommended),
            "Change of the estimate",
            f"RMS of the difference in {REPORTED_TEXT}; modes that are not estimated count as zero.",
        ),
        Stack([Table(NUMBER_COLUMNS, _number_rows(numbers), "Number of modes", _number_caption(numbers))]),
    ]


def _number_rows(numbers: NumberScan) -> list[tuple[str, ...]]:
    return [
        (
            str(highest) + (" *" if highest == numbers.recommended else ""),
            number(seen, ".3f"),
            with_error(above, sigma, "+.4f"),
            number(fitted, ".2f"),
            number(change),
            number(half),
        )
        for highest, seen, above, sigma, fitted, change, half in zip(
            numbers.highest_noll,
            numbers.held_out_chi2_nu,
            numbers.excess,
            numbers.excess_sigma,
            numbers.fitted_chi2_nu,
            numbers.change_nm,
            numbers.halves_nm,
            strict=True,
        )
    ]


def _number_caption(numbers: NumberScan) -> str:
    return f"{plural(numbers.cubes, 'cube')}; *: recommended."


# -- drawings ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Points:
    """Standard deviations of the modes, with a law through them.

    Attributes
    ----------
    noll, std_nm : ndarray, (modes,)
    law_nm : ndarray, (modes,), optional
    sigma_nm : ndarray, (modes,), optional
    """

    noll: np.ndarray
    std_nm: np.ndarray
    law_nm: np.ndarray | None = None
    sigma_nm: np.ndarray | None = None


def strength_plot(
    name: str, points: Mapping[str, Points], lines: Mapping[str, np.ndarray] | None = None
) -> Markup:
    """Draw standard deviations against Noll index.

    Parameters
    ----------
    name : str
        Unique in the page.
    points : mapping of str to Points
        By label.
    lines : mapping of str to ndarray, (2, modes), optional
        Noll index and value, by label.
    """

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, (label, one) in enumerate(points.items()):
            colour, marker = CYCLE[place % len(CYCLE)], MARKERS[place % len(MARKERS)]
            axes.errorbar(
                one.noll,
                one.std_nm,
                one.sigma_nm,
                fmt=marker,
                color=colour,
                markersize=3,
                linewidth=0.6,
                label=label,
            )
            if one.law_nm is not None:
                axes.plot(one.noll, one.law_nm, color=colour)
        for label, (noll, value_nm) in (lines or {}).items():
            axes.plot(noll, value_nm, "--", color=INK, linewidth=0.9, label=label)
        axes.set(xlabel="Noll index", ylabel="standard deviation [nm RMS]")
        log_y(axes, *(one.std_nm for one in points.values()))
        figure.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)


def misfit_plot(
    name: str, numbers: Sequence[int], excess: np.ndarray, sigma: np.ndarray, recommended: int
) -> Markup:
    """Draw the misfit of unseen frames above the least one against the number of modes.

    Parameters
    ----------
    name : str
        Unique in the page.
    numbers : sequence of int
        Highest Noll indices.
    excess, sigma : ndarray, (numbers,)
        χ²/ν above the least, with its error.
    recommended : int
        Number to be marked.
    """

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.errorbar(numbers, excess, sigma, fmt="o-", markersize=4)
        axes.axvline(recommended, color=INK, linewidth=0.8, linestyle=":")
        smallest = np.min(excess[excess > 0], initial=np.inf)
        axes.set_yscale("symlog", linthresh=smallest if np.isfinite(smallest) else 1.0)
        axes.set(xlabel="highest Noll mode estimated", ylabel="χ²/ν of unseen frames above the least")

    return svg(name, SIZE_IN, draw)


def error_plot(
    name: str, numbers: Sequence[int], curves: Mapping[str, np.ndarray], ylabel: str, mark: int | None = None
) -> Markup:
    """Draw one curve per label against the number of modes.

    Parameters
    ----------
    name : str
        Unique in the page.
    numbers : sequence of int
        Highest Noll indices.
    curves : mapping of str to ndarray, (numbers,)
    ylabel : str
    mark : int, optional
        Number that gets a line.
    """

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, (label, values) in enumerate(curves.items()):
            marker = MARKERS[place % len(MARKERS)]
            axes.plot(
                numbers, values, f"{marker}-", color=CYCLE[place % len(CYCLE)], markersize=4, label=label
            )
        if mark is not None:
            axes.axvline(mark, color=INK, linewidth=0.8, linestyle=":")
        log_y(axes, *curves.values())
        axes.set(xlabel="highest Noll mode estimated", ylabel=ylabel)
        figure.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)
