"""Section on the standard deviation of the modes on simulated cubes."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_modes import Points, law_table, strength_plot
from irlos_pipe.report.text import number, plural
from irlos_pipe.stages.modes import LawRow

STAGE = "mode_statistics"
NAMES = {
    "introduced": "introduced",
    "long_exposure": "this pipeline's default",
    "dip_global": "DIP global",
}


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    blocks = _strength(run)
    if results.get("laws"):
        blocks += [Stack([_beyond(results)]), _laws(results)]
    return Section(STAGE, "Standard deviation of the modes, simulated", _lead(results), blocks)


def _laws(results: dict[str, Any]) -> Table:
    """Laws of the introduced modes, and of all that were estimated."""
    last = results["modes_introduced"] + 1
    rows, names = {}, {}
    for kind, which in (("laws_of_introduced_modes", f"Noll 4–{last}"), ("laws", "all from Noll 4 on")):
        for method, law in results[kind].items():
            rows[f"{kind}/{method}"], names[f"{kind}/{method}"] = (
                LawRow.model_validate(law),
                f"{NAMES[method]}, {which}",
            )
    return law_table(rows, names)


def _lead(results: dict[str, Any]) -> str:
    return (
        f"{results.get('modes_estimated')} modes estimated in {plural(results.get('cubes', 0), 'cube')} with "
        f"NCPAs of {results.get('modes_introduced')} modes: what an estimate tells of the others is "
        "cross-talk and noise."
    )


def _strength(run: RunData) -> list[Figure]:
    noll = run.array(STAGE, "noll")
    found = {text: run.array(STAGE, f"{name}/std_nm") for name, text in NAMES.items()}
    if noll is None or any(std is None for std in found.values()):
        return []
    laws = {text: run.array(STAGE, f"{name}/law_nm") for name, text in NAMES.items()}
    points = {
        text: Points(noll, np.where(std > 0, std, np.nan), None if text == "introduced" else laws[text])
        for text, std in found.items()
    }
    caption = (
        "RMS over the cubes, tip and tilt equalised. Lines: laws fitted from Noll 4 on, that of DIP global "
        "to all modes, the others to the introduced ones."
    )
    lines = {"law of the introduced modes": np.stack([noll, laws["introduced"]])}
    return [Figure(strength_plot("mode-statistics", points, lines), "Strength of the modes", caption)]


def _beyond(results: dict[str, Any]) -> Table:
    rows = [
        (NAMES[name], number(value, ".2f"), number(np.median(results["error_nm"].get(name, [np.nan]))))
        for name, value in results["beyond_nm"].items()
    ]
    columns = ("", "RMS per mode beyond [nm]", "error from Noll 4 on, median [nm]")
    caption = "Beyond: modes that were not introduced; a perfect estimate finds nothing there."
    return Table(columns, rows, "Modes that were not introduced", caption)
