"""Section on the standard deviation of the modes on simulated cubes."""

from __future__ import annotations

import numpy as np

from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, PAPER_CHOICE
from irlos_pipe.paper.mode_statistics.results import ModeStatisticsResults
from irlos_pipe.paper.mode_statistics.stage import TRUTH
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_modes import Points, law_table, strength_plot
from irlos_pipe.report.text import number, plural

STAGE = ModeStatisticsResults.stage
NAMES = {TRUTH: TRUTH} | {method: METHOD_NAMES[method] for method in (DEFAULT, PAPER_CHOICE)}


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(ModeStatisticsResults)
    blocks: list[Block] = [_strength(run), Stack([_beyond(results)]), _laws(results)]
    lead = (
        f"{results.modes_estimated} modes estimated in {plural(results.cubes, 'cube')} with NCPAs of "
        f"{results.modes_introduced} modes: what an estimate contains of the others is cross-talk and noise."
    )
    return Section(STAGE, "Standard deviation of the modes, simulated", lead, blocks)


def _laws(results: ModeStatisticsResults) -> Table:
    """Laws of the introduced modes, and of all that were estimated."""
    last = results.modes_introduced + 1
    kinds = {f"Noll 4–{last}": results.laws_of_introduced_modes, "all from Noll 4 on": results.laws}
    rows = {f"{NAMES[name]}, {which}": law for which, laws in kinds.items() for name, law in laws.items()}
    return law_table(rows, {name: name for name in rows})


def _strength(run: RunData) -> Figure:
    noll = array_of(run, STAGE, "noll")
    laws = {name: array_of(run, STAGE, f"{name}/law_nm") for name in NAMES}
    points = {}
    for name, text in NAMES.items():
        std = array_of(run, STAGE, f"{name}/std_nm")
        points[text] = Points(noll, np.where(std > 0, std, np.nan), None if name == TRUTH else laws[name])
    caption = (
        "RMS over the cubes, tip and tilt equalised. Lines: laws fitted from Noll 4 on, that of DIP global "
        "to all modes, the others to the introduced ones."
    )
    lines = {"law of the introduced modes": np.stack([noll, laws[TRUTH]])}
    return Figure(strength_plot("mode-statistics", points, lines), "Strength of the modes", caption)


def _beyond(results: ModeStatisticsResults) -> Table:
    errors = {name: float(np.median(values)) for name, values in results.error_nm.items()}
    rows = [
        (NAMES[name], number(value, ".2f"), number(errors.get(name)))
        for name, value in results.beyond_nm.items()
    ]
    columns = ("", "RMS per mode beyond [nm]", "error from Noll 4 on, median [nm]")
    caption = "Beyond: modes that were not introduced; a perfect estimate finds nothing there."
    return Table(columns, rows, "Modes that were not introduced", caption)
