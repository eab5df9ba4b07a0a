"""Section on the sensitivity: error and failures against magnitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table
from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number, plural
from irlos_pipe.stages.sensitivity import CriterionRow, CurveRow, NoiseRow, SensitivityResults

STAGE = "sensitivity"
MARKERS = ("o", "s", "^", "D", "v", "P")
CAPTION = (
    f"Bands: 16th to 84th percentile. Dashed: Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median "
    "|error| of an efficient estimate; dotted: the same of exposures of one read without sky. Horizontal and "
    "vertical lines: criterion and limiting magnitudes. Errors are against the introduced defocus: without "
    "NCPAs, theirs counts as an error."
)
COLUMNS = (
    "NCPAs",
    "modes",
    "limit [J mag]",
    "limit of the bound, one read without sky [J mag]",
    "median |error| of the brightest [nm]",
)
NOISE_COLUMNS = ("", "dimmed frames", "one read without sky")


def sensitivity_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(SensitivityResults)
    return Section(STAGE, "Sensitivity", _lead(results.curves), _blocks(results))


def _blocks(results: SensitivityResults) -> list[Block]:
    rows, criterion = results.curves, results.criterion
    if not rows:
        return []
    drawing = sensitivity_plot("sensitivity", [Curve.of(row, curve_label(row)) for row in rows], criterion)
    limits = Table(COLUMNS, [_row(row) for row in rows], "Limiting magnitude", criterion_text(criterion))
    tables = [limits] if results.noise.reads is None else [limits, _noise_table(results.noise)]
    return [Figure(drawing, "Defocus error against magnitude", CAPTION), Stack(tables)]


def _noise_table(noise: NoiseRow) -> Table:
    """What the dimmed frames are noisier by than one read without sky."""
    light = f"{number(noise.sky_e, '.2f')} + {number(noise.dark_e, '.2f')}"
    read_e, factor = number(noise.read_noise_e, ".2g"), number(noise.excess_noise_factor, ".2f")
    floors = (number(floor, ".3g") for floor in (noise.floor_e2, noise.one_read_floor_e2))
    rows = [
        ("reads in an exposure", str(noise.reads), "1"),
        ("noise of a read [e⁻]", read_e, read_e),
        ("sky + dark [e⁻ per pixel]", light, "0 + 0"),
        ("excess noise factor", factor, "1.00"),
        ("variance without star [e⁻²]", *floors),
    ]
    ratio = number(noise.floor_e2 / noise.one_read_floor_e2, ".3g")
    text = f"The variance without star is {ratio} times that of one read without sky."
    return Table(NOISE_COLUMNS, rows, "Noise of a pixel", text)


def _lead(rows: Sequence[CurveRow]) -> str:
    trials = [row.trials for row in rows if row.trials is not None]
    if not trials:
        return ""
    return (
        f"Frames dimmed to fainter stars, {max(trials)} estimates per magnitude. Errors are those of single "
        "frames against the introduced defocus."
    )


def noise_text(noise: NoiseRow) -> str:
    """Return in a few words what the dimmed frames are noisy by; nothing where that is not known."""
    if noise.reads is None:
        return ""
    sky = number(noise.sky_e, ".2g", "e⁻/px of sky")
    return f"{sky}, {plural(noise.reads, 'read')} of {number(noise.read_noise_e, '.2g', 'e⁻')}"


def curve_label(row: CurveRow) -> str:
    """Return how the frames of a curve were estimated."""
    return f"{'with' if row.calibrated else 'without'} NCPAs, {len(row.modes)} modes"


def _row(row: CurveRow) -> tuple[str, ...]:
    return (
        "added" if row.calibrated else "left out",
        ", ".join(map(str, row.modes)),
        limit_text(row),
        number(row.one_read_bound_mag),
        number(row.median_abs_error_nm[0]) if row.median_abs_error_nm else MISSING,
    )


# -- drawings ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """How a curve is drawn; only a `main` one has its spread, its bound and its limit drawn too."""

    colour: str
    marker: str
    main: bool = True


LOOKS = tuple(Look(colour, marker) for colour, marker in zip(CYCLE, MARKERS, strict=True))


@dataclass(frozen=True)
class Curve:
    """One curve as arrays over magnitude; NaN where a value is missing."""

    label: str
    mag_j: np.ndarray
    median_nm: np.ndarray
    p16_nm: np.ndarray
    p84_nm: np.ndarray
    crb_nm: np.ndarray
    one_read_crb_nm: np.ndarray
    failed: np.ndarray
    limit_mag: float

    @classmethod
    def of(cls, row: CurveRow, label: str) -> Curve:
        """Return the curve of a `row` of the results, to be shown as `label`."""

        def values(found: Sequence[float]) -> np.ndarray:
            return np.array(found, dtype=float) if found else np.full(len(row.mag_j), np.nan)

        return cls(
            label,
            values(row.mag_j),
            values(row.median_abs_error_nm),
            values(row.p16_nm),
            values(row.p84_nm),
            values(row.crb_nm),
            values(row.one_read_crb_nm),
            values(row.failures) / (row.trials or np.nan),
            row.limit_mag,
        )


def limit_text(row: CurveRow) -> str:
    """Return the limiting magnitude of a curve; with ``≥`` where the magnitudes end before."""
    return ("≥ " if row.at_the_end else "") + number(row.limit_mag)


def criterion_text(criterion: CriterionRow) -> str:
    """Return what a limiting magnitude means."""
    error = number(criterion.median_abs_error_nm, ".0f", "nm")
    failures = number(criterion.failures, ".0%")
    return (
        f"Faintest magnitude with median |error| ≤ {error} and ≤ {failures} failures; "
        f"≥: the magnitudes end before. {MISSING}: met at no magnitude."
    )


def sensitivity_plot(
    name: str,
    curves: Sequence[Curve],
    criterion: CriterionRow,
    looks: Sequence[Look] = LOOKS,
    floor_nm: float | None = None,
) -> Markup:
    """Draw median errors above and failures below.

    Parameters
    ----------
    name : str
        Unique in the page.
    curves : sequence of Curve
    criterion : CriterionRow
        Drawn as levels.
    looks : sequence of Look
        One per curve; repeated if there are fewer.
    floor_nm : float, optional
        Median error of a perfect sensor.
    """

    def draw(figure: Canvas) -> None:
        top, bottom = figure.subplots(2, sharex=True, height_ratios=(3, 1))
        for place, curve in enumerate(curves):
            look = looks[place % len(looks)]
            _draw_errors(top, curve, look)
            bottom.plot(curve.mag_j, 100 * curve.failed, f"{look.marker}-", color=look.colour, markersize=3.5)
        _draw_level(top, floor_nm, 1, ":", "AO residual's own defocus")
        _draw_level(top, criterion.median_abs_error_nm, 1, "-.")
        _draw_level(bottom, criterion.failures, 100, "-.")
        top.set_ylabel("median |error| [nm RMS]")
        log_y(top, *(curve.median_nm for curve in curves))
        figure.legend(loc="outside upper center", ncols=2)
        bottom.set(xlabel="J magnitude", ylabel="failures [%]")
        bottom.set_ylim(bottom=-2)

    return svg(name, (5.2, 4.8), draw)


def _draw_errors(axes: Axes, curve: Curve, look: Look) -> None:
    axes.plot(
        curve.mag_j,
        curve.median_nm,
        f"{look.marker}-",
        color=look.colour,
        markersize=3.5,
        linewidth=1.4 if look.main else 0.8,
        label=curve.label,
    )
    if look.main:
        axes.fill_between(curve.mag_j, curve.p16_nm, curve.p84_nm, color=look.colour, alpha=0.15, linewidth=0)
        axes.plot(curve.mag_j, MEDIAN_OF_NORMAL * curve.crb_nm, "--", color=look.colour, linewidth=0.9)
        axes.plot(
            curve.mag_j, MEDIAN_OF_NORMAL * curve.one_read_crb_nm, ":", color=look.colour, linewidth=0.9
        )
    if look.main and np.isfinite(curve.limit_mag):
        axes.axvline(curve.limit_mag, color=look.colour, linewidth=0.8, linestyle=":")


def _draw_level(axes: Axes, level: float | None, factor: float, style: str, label: str | None = None) -> None:
    if level is not None and np.isfinite(level):
        axes.axhline(factor * level, color=INK, linewidth=0.8, linestyle=style, label=label)
