"""Section on how faint LIFT goes, by simulated frames that were dimmed."""

from __future__ import annotations

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.paper.faint.results import ExposureGroup, FaintCriterion, FaintResults, VariantCurve
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, ORANGE
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_sensitivity import Curve, Look, criterion_text, limit_text, sensitivity_plot
from irlos_pipe.report.text import number

STAGE = FaintResults.stage
LABELS = {"none": "no NCPAs", "published": "NCPAs by DIP global", "default": "this pipeline"}
COLOURS = {"none": ORANGE, "published": GREEN, "default": BLUE}
CAPTION = (
    "Median |estimated − introduced defocus|. Circles, thick lines: three modes, with the 16th to 84th "
    f"percentile as a band and, dashed, the Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median |error| of "
    "an efficient estimate (dotted lines: of frames of one read without sky). Squares: nine modes. Dotted: a "
    "perfect sensor, which sees the mean defocus of the AO residual in every frame. Dash-dotted and vertical "
    "lines: criterion and limiting magnitudes."
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(FaintResults)
    groups, criterion = results.exposures, results.criterion
    blocks: list[Block] = [*(_figure(group, criterion) for group in groups), _table(groups, criterion)]
    return Section(STAGE, "Sensitivity, simulated", _lead(groups), blocks)


def _lead(groups: list[ExposureGroup]) -> str:
    limits = "; ".join(_limits(group) for group in groups)
    return (
        f"Limiting m_J without NCPAs, with those of DIP global, with this pipeline's (three modes): {limits}."
    )


def _limits(group: ExposureGroup) -> str:
    limits = {curve.key: limit_text(curve) for curve in group.curves}
    return f"{' → '.join(limits[f'{kind}_3'] for kind in LABELS)} at {group.exposure_s:g} s"


def _figure(group: ExposureGroup, criterion: FaintCriterion) -> Figure:
    drawing = sensitivity_plot(
        f"faint-{group.exposure_s:g}".replace(".", "-"),
        [Curve.of(curve, f"{LABELS[curve.kind]}, {len(curve.modes)} modes") for curve in group.curves],
        criterion,
        [_look(curve) for curve in group.curves],
        group.residual_floor_nm,
    )
    return Figure(drawing, f"Exposures of {group.exposure_s:g} s", CAPTION)


def _look(curve: VariantCurve) -> Look:
    few = len(curve.modes) == 3
    return Look(COLOURS[curve.kind], "o" if few else "s", main=few)


def _table(groups: list[ExposureGroup], criterion: FaintCriterion) -> Table:
    columns = ["estimate", "modes"]
    for group in groups:
        own = f"at {group.exposure_s:g} s"
        columns += [f"limit {own} [J mag]", f"bound {own}, one read [J mag]", "error at the bright end [nm]"]
    rows = [_row(together) for together in zip(*(group.curves for group in groups), strict=True)]
    marks = ["good" if curve.key.startswith("default") else "" for curve in groups[0].curves]
    trials = max(curve.trials or 0 for group in groups for curve in group.curves)
    caption = (
        f"{criterion_text(criterion)} {trials} estimates per magnitude. Bound: an efficient estimate of "
        "frames of one read without sky."
    )
    return Table(columns, rows, "Limiting magnitude", caption, marks)


def _row(together: tuple[VariantCurve, ...]) -> list[str]:
    cells = [together[0].label, str(len(together[0].modes))]
    for curve in together:
        cells += [limit_text(curve), number(curve.one_read_bound_mag), number(curve.median_abs_error_nm[0])]
    return cells
