"""Section on the sensitivity: error and failures against magnitude."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.conventions.units import MEDIAN_OF_NORMAL
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import MISSING, number, plural
from irlos_pipe.stages.sensitivity import CriterionRow, CurveRow, NoiseRow, SensitivityResults

CAPTION = (
    f"Bands: 16th to 84th percentile. Dashed: Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median "
    "|error| of an efficient estimate; dotted: the same of exposures of one read without sky. Horizontal and "
    "vertical lines: criterion and limiting magnitudes. Errors are against the introduced defocus: without "
    "NCPAs, theirs counts as an error."
)
Sensitivity = StageData[SensitivityResults]


def sensitivity_section(run: RunData) -> Section:
    of = run.of(SensitivityResults)
    trials = [row.trials for row in of.results.curves if row.trials is not None]
    lead = (
        f"Frames dimmed to fainter stars, {max(trials)} estimates per magnitude. Errors are those of single "
        "frames against the introduced defocus."
        if trials
        else ""
    )
    return Section(of.stage, "Sensitivity", lead, of.blocks(_curves, _tables) if of.results.curves else [])


def _curves(of: Sensitivity) -> Figure:
    curves = [(curve_label(row), row) for row in of.results.curves]
    drawing = sensitivity_plot("sensitivity", curves, of.results.criterion)
    return Figure(drawing, "Defocus error against magnitude", CAPTION)


def _tables(of: Sensitivity) -> Stack:
    criterion, noise = of.results.criterion, of.results.noise
    limits = Table.of(
        of.results.curves,
        {
            "NCPAs": lambda row: "added" if row.calibrated else "left out",
            "modes": lambda row: ", ".join(map(str, row.modes)),
            "limit [J mag]": limit_text,
            "limit of the bound, one read without sky [J mag]": lambda row: number(row.one_read_bound_mag),
            "median |error| of the brightest [nm]": lambda row: number(
                next(iter(row.median_abs_error_nm), None)
            ),
        },
        "Limiting magnitude",
        f"Faintest magnitude with median |error| ≤ {number(criterion.median_abs_error_nm, '.0f', 'nm')} "
        f"and ≤ {number(criterion.failures, '.0%')} failures; "
        f"≥: the magnitudes end before. {MISSING}: met at no magnitude.",
    )
    return Stack([limits] if noise.reads is None else [limits, _noise(noise)])


def _noise(noise: NoiseRow) -> Table:
    """What the dimmed frames are noisier by than one read without sky."""
    read_e, factor = number(noise.read_noise_e, ".2g"), number(noise.excess_noise_factor, ".2f")
    floors = (number(floor, ".3g") for floor in (noise.floor_e2, noise.one_read_floor_e2))
    rows = [
        ("reads in an exposure", str(noise.reads), "1"),
        ("noise of a read [e⁻]", read_e, read_e),
        (
            "sky + dark [e⁻ per pixel]",
            f"{number(noise.sky_e, '.2f')} + {number(noise.dark_e, '.2f')}",
            "0 + 0",
        ),
        ("excess noise factor", factor, "1.00"),
        ("variance without star [e⁻²]", *floors),
    ]
    ratio = number(noise.floor_e2 / noise.one_read_floor_e2, ".3g")
    text = f"The variance without star is {ratio} times that of one read without sky."
    return Table(("", "dimmed frames", "one read without sky"), rows, "Noise of a pixel", text)


def noise_text(noise: NoiseRow) -> str:
    """Return in a few words what the dimmed frames are noisy by; nothing where that is not known."""
    if noise.reads is None:
        return ""
    sky = number(noise.sky_e, ".2g", "e⁻/px of sky")
    return f"{sky}, {plural(noise.reads, 'read')} of {number(noise.read_noise_e, '.2g', 'e⁻')}"


def curve_label(row: CurveRow) -> str:
    """Return how the frames of a curve were estimated."""
    return f"{'with' if row.calibrated else 'without'} NCPAs, {len(row.modes)} modes"


def limit_text(row: CurveRow) -> str:
    """Return the limiting magnitude of a curve; with ``≥`` where the magnitudes end before."""
    return ("≥ " if row.at_the_end else "") + number(row.limit_mag)


# -- drawing -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """How a curve is drawn; only a `main` one has its spread, its bound and its limit drawn too."""

    colour: str
    marker: str
    main: bool = True


LOOKS = tuple(map(Look, CYCLE, ("o", "s", "^", "D", "v", "P")))


def sensitivity_plot(
    name: str,
    curves: Sequence[tuple[str, CurveRow]],
    criterion: CriterionRow,
    looks: Sequence[Look] = LOOKS,
    floor_nm: float | None = None,
) -> Markup:
    """Draw median errors above and failures below, with the `criterion` as levels, of labelled `curves`.

    Fewer `looks` than curves are repeated; `floor_nm` is the median error of a perfect sensor.
    """

    def draw(canvas: Canvas) -> None:
        top, bottom = canvas.subplots(2, sharex=True, height_ratios=(3, 1))
        for place, (label, row) in enumerate(curves):
            look = looks[place % len(looks)]
            colour, mag_j, width = look.colour, row.mag_j, 1.4 if look.main else 0.8
            points: dict[str, Any] = {"markersize": 3.5, "linewidth": width, "label": label}
            top.plot(mag_j, row.values("median_abs_error_nm"), f"{look.marker}-", color=colour, **points)
            if look.main:
                ends = row.values("p16_nm"), row.values("p84_nm")
                top.fill_between(mag_j, *ends, color=colour, alpha=0.15, linewidth=0)
                for bound, style in (("crb_nm", "--"), ("one_read_crb_nm", ":")):
                    top.plot(mag_j, MEDIAN_OF_NORMAL * row.values(bound), style, color=colour, linewidth=0.9)
                if np.isfinite(row.limit_mag):
                    top.axvline(row.limit_mag, color=colour, linewidth=0.8, linestyle=":")
            failed = row.values("failures") / (row.trials or np.nan)
            bottom.plot(row.mag_j, 100 * failed, f"{look.marker}-", color=look.colour, markersize=3.5)
        _draw_level(top, floor_nm, 1, ":", "AO residual's own defocus")
        _draw_level(top, criterion.median_abs_error_nm, 1, "-.")
        _draw_level(bottom, criterion.failures, 100, "-.")
        top.set_ylabel("median |error| [nm RMS]")
        log_y(top, *(row.values("median_abs_error_nm") for _, row in curves))
        canvas.legend(loc="outside upper center", ncols=2)
        bottom.set(xlabel="J magnitude", ylabel="failures [%]")
        bottom.set_ylim(bottom=-2)

    return svg(name, (5.2, 4.8), draw)


def _draw_level(axes: Axes, level: float | None, factor: float, style: str, label: str | None = None) -> None:
    if level is not None and np.isfinite(level):
        axes.axhline(factor * level, color=INK, linewidth=0.8, linestyle=style, label=label)
