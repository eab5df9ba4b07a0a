"""Section on the modes: how strong they are, and how many to estimate."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.mode_plots import Points, error_plot, misfit_plot, strength_plot
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error

STAGE = "modes"
LAWS = {"estimates": "of the estimates", "ncpas": "without their errors"}
LAW_COLUMNS = ("law", "A [nm]", "B", "C [nm]", "deviance/ν", "plateau from Noll")
NUMBER_COLUMNS = (
    "Noll 2 to",
    "χ²/ν unseen",
    "above the least",
    "χ²/ν fitted",
    "change in Noll 2–30 [nm]",
    "error from the halves [nm]",
)


def modes_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    blocks = [*_strength(run, results), Stack([law_table(results.get("laws", {}), LAWS)]), *_numbers(run)]
    return Section(STAGE, "Strength and number of modes", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    cubes, draws = results.get("cubes", 0), results.get("draws", 0)
    text = f"{results.get('method')} on {plural(cubes, 'cube')}, each by itself; {plural(draws, 'draw')}"
    rest = ": enough for a law, not for the standard deviation of a single mode" if draws == 1 else ""
    return f"{text} of every mode{rest}."


def _strength(run: RunData, results: dict[str, Any]) -> list[Figure]:
    noll, std, frames = (run.array(STAGE, name) for name in ("noll", "std_nm", "frame_std_nm"))
    if noll is None or std is None:
        return []
    several = results.get("draws", 1) > 1
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


def law_table(laws: dict[str, dict[str, Any]], names: dict[str, str]) -> Table:
    """Tabulate fitted laws; `names` says what each was fitted to."""
    rows = [
        (
            names.get(name, name),
            with_error(law.get("A_nm"), law.get("A_sigma_nm"), ".1f"),
            with_error(law.get("B"), law.get("B_sigma"), ".3f"),
            with_error(law.get("C_nm"), law.get("C_sigma_nm"), ".1f"),
            number(law.get("deviance_nu"), ".2f"),
            number(law.get("plateau_noll"), "d"),
        )
        for name, law in laws.items()
    ]
    caption = (
        "std(i) = A exp(−B i) + C, i = 0 for Noll 2; maximum likelihood. The plateau begins where the "
        "exponential is a tenth of C."
    )
    return Table(LAW_COLUMNS, rows, "Law of the standard deviation", caption)


def _numbers(run: RunData) -> list[Figure | Table]:
    numbers = run.results(STAGE).get("numbers")
    if not numbers:
        return []
    highest = numbers["highest_noll"]
    excess, sigma = (np.array(numbers[key], dtype=float) for key in ("excess", "excess_sigma"))
    change = np.array(numbers["change_nm"], dtype=float)
    curves = {
        "change from the recommended number": np.where(change > 0, change, np.nan),
        "error from the difference of the halves": np.array(numbers["halves_nm"], dtype=float),
    }
    recommended = numbers["recommended"]
    return [
        Figure(
            misfit_plot("modes-misfit", highest, excess, sigma, recommended),
            "Frames that no fit has seen",
            f"One half of the frames fitted, the other predicted. Dotted: Noll 2–{recommended}, the fewest "
            "modes that predict them as well as any, within the error.",
        ),
        Figure(
            error_plot("modes-change", highest, curves, "RMS in Noll 2–30 [nm]", recommended),
            "Change of the estimate",
            "RMS of the difference in Noll 2–30; modes that are not estimated count as zero.",
        ),
        Stack([Table(NUMBER_COLUMNS, _number_rows(numbers), "Number of modes", _told(numbers))]),
    ]


def _number_rows(numbers: dict[str, Any]) -> list[tuple[str, ...]]:
    keys = ("held_out_chi2_nu", "excess", "excess_sigma", "fitted_chi2_nu", "change_nm", "halves_nm")
    return [
        (
            str(highest) + (" *" if highest == numbers["recommended"] else ""),
            number(seen, ".3f"),
            with_error(above, sigma, "+.4f"),
            number(fitted, ".2f"),
            number(change),
            number(half),
        )
        for highest, seen, above, sigma, fitted, change, half in zip(
            numbers["highest_noll"], *(numbers[key] for key in keys), strict=True
        )
    ]


def _told(numbers: dict[str, Any]) -> str:
    return f"{plural(numbers['cubes'], 'cube')}; *: recommended."
