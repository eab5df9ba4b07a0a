"""Section on how faint LIFT goes, by simulated frames that were dimmed."""

from __future__ import annotations

from typing import Any

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, ORANGE
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_sensitivity import Curve, Look, criterion_text, limit_text, sensitivity_plot
from irlos_pipe.report.text import number
from irlos_pipe.stages.sensitivity import CriterionRow, CurveRow

STAGE = "faint"
LABELS = {"none": "no NCPAs", "published": "NCPAs by DIP global", "default": "this pipeline"}
COLOURS = {"none": ORANGE, "published": GREEN, "default": BLUE}
CAPTION = (
    "Median |estimated − introduced defocus|. Circles, thick lines: three modes, with the 16th to 84th "
    f"percentile as a band and, dashed, the Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median |error| of "
    "an efficient estimate. Squares: nine modes. Dotted: a perfect sensor, which sees the mean defocus of "
    "the AO residual in every frame. Dash-dotted and vertical lines: criterion and limiting magnitudes."
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    groups, criterion = results.get("exposures", []), results.get("criterion") or {}
    blocks = [*(_figure(group, criterion) for group in groups), _table(groups, criterion)]
    return Section(STAGE, "Sensitivity, simulated", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    told = "; ".join(_limits(group) for group in results.get("exposures", []))
    return (
        f"Limiting m_J without NCPAs, with those of DIP global, with this pipeline's (three modes): {told}."
    )


def _limits(group: dict[str, Any]) -> str:
    limits = {row["key"]: limit_text(CurveRow.model_validate(row)) for row in group["curves"]}
    told = " → ".join(limits[f"{kind}_3"] for kind in LABELS)
    return f"{told} at {group['exposure_s']:g} s"


def _figure(group: dict[str, Any], criterion: dict[str, Any]) -> Figure:
    rows = group["curves"]
    drawing = sensitivity_plot(
        f"faint-{group['exposure_s']:g}".replace(".", "-"),
        [Curve.of(CurveRow.model_validate(row), _label(row)) for row in rows],
        CriterionRow.model_validate(criterion),
        [_look(row) for row in rows],
        group["residual_floor_nm"],
    )
    return Figure(drawing, f"Exposures of {group['exposure_s']:g} s", CAPTION)


def _kind(row: dict[str, Any]) -> str:
    return row["key"].rpartition("_")[0]


def _label(row: dict[str, Any]) -> str:
    return f"{LABELS[_kind(row)]}, {len(row['modes'])} modes"


def _look(row: dict[str, Any]) -> Look:
    few = len(row["modes"]) == 3
    return Look(COLOURS[_kind(row)], "o" if few else "s", main=few)


def _table(groups: list[dict[str, Any]], criterion: dict[str, Any]) -> Table:
    columns = ["estimate", "modes"]
    for group in groups:
        columns += [f"limit at {group['exposure_s']:g} s [J mag]", "error at the bright end [nm]"]
    rows = [_row(together) for together in zip(*(group["curves"] for group in groups), strict=True)]
    marks = (
        ["good" if row["key"].startswith("default") else "" for row in groups[0]["curves"]] if groups else []
    )
    return Table(
        columns,
        rows,
        "Limiting magnitude",
        f"{criterion_text(CriterionRow.model_validate(criterion))} {_sizes(groups)}",
        marks,
    )


def _row(together: tuple[dict[str, Any], ...]) -> list[str]:
    cells = [together[0]["label"], str(len(together[0]["modes"]))]
    for row in together:
        cells += [limit_text(CurveRow.model_validate(row)), number(row["median_abs_error_nm"][0])]
    return cells


def _sizes(groups: list[dict[str, Any]]) -> str:
    trials = {row["trials"] for group in groups for row in group["curves"]}
    return f"{max(trials)} estimates per magnitude." if trials else ""
