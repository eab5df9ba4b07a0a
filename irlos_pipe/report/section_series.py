"""Sections on cubes that are calibrated one by one: strength and number of their modes, and the derotator."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.conventions.modes import REPORTED_TEXT
from irlos_pipe.product.results import StageResults
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Width
from irlos_pipe.report.drawing import CYCLE, INK, MARKERS, log_y, plot, svg
from irlos_pipe.report.images import common_limit_nm, wavefront_grid
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import number, plural, with_error
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.derotator import DerotatorResults
from irlos_pipe.stages.modes import ModesResults, NumberScan

SIZE_IN = (5.2, 3.6)
LAWS = {"estimates": "of the estimates", "ncpas": "without their errors"}
Modes = StageData[ModesResults]


def modes_section(run: RunData) -> Section:
    of = run.of(ModesResults)
    results = of.results
    text = f"{results.method} on {plural(results.cubes, 'cube')}, each by itself"
    single = ": enough for a law, not for the standard deviation of a single mode"
    lead = f"{text}; {plural(results.draws, 'draw')} of every mode{single if results.draws == 1 else ''}."
    return Section(of.stage, "Strength and number of modes", lead, of.blocks(_strength, _laws, _numbers))


def _strength(of: Modes) -> Figure:
    noll, std, several = of["noll"], of["std_nm"], of.results.draws > 1
    label = "RMS over the cubes" if several else "|coefficient|"
    fitted = of["law/estimates_nm"] if "law/estimates_nm" in of.arrays else None
    points = {
        label: Points(noll, std, fitted, of.error_of("std_nm") if several else None),
        "over the frames of a cube": Points(noll, of["frame_std_nm"]),
    }
    known = "law/ncpas_nm" in of.arrays
    lines = {"law without errors": np.stack([noll, of["law/ncpas_nm"]])} if known else {}
    caption = (
        "Line: fitted law (tip and tilt left out). The scatter over frames is that of the AO residual "
        "and the noise; it says nothing about NCPAs."
    )
    return Figure(strength_plot("modes-strength", points, lines), "Strength of the modes", caption)


def _laws(of: Modes) -> Stack:
    table = Table.of(
        of.results.laws.items(),
        {
            "law": lambda one: LAWS.get(one[0], one[0]),
            "A [nm]": lambda one: with_error(one[1].A_nm, one[1].A_sigma_nm, ".1f"),
            "B": lambda one: with_error(one[1].B, one[1].B_sigma, ".3f"),
            "C [nm]": lambda one: with_error(one[1].C_nm, one[1].C_sigma_nm, ".1f"),
            "deviance/ν": lambda one: number(one[1].deviance_nu, ".2f"),
            "plateau from Noll": lambda one: number(one[1].plateau_noll, "d"),
        },
        "Law of the standard deviation",
        "std(i) = A exp(−B i) + C, i = 0 for Noll 2; maximum likelihood. The plateau begins where the "
        "exponential is a tenth of C.",
    )
    return Stack([table])


def _numbers(of: Modes) -> list[Block]:
    numbers = of.results.numbers
    return [] if numbers is None else [_misfit(numbers), _change(numbers), Stack([_table(numbers)])]


def _misfit(numbers: NumberScan) -> Figure:
    """Misfit of unseen frames above the least one, against the number of modes."""
    excess, recommended = np.array(numbers.excess), numbers.recommended

    def draw(axes: Axes) -> None:
        axes.errorbar(numbers.highest_noll, excess, numbers.excess_sigma, fmt="o-", markersize=4)
        axes.axvline(recommended, color=INK, linewidth=0.8, linestyle=":")
        smallest = np.min(excess[excess > 0], initial=np.inf)
        axes.set_yscale("symlog", linthresh=smallest if np.isfinite(smallest) else 1.0)

    caption = (
        f"One half of the frames fitted, the other predicted. Dotted: Noll 2–{recommended}, the fewest "
        "modes that predict them as well as any, within the error."
    )
    labels = ("highest Noll mode estimated", "χ²/ν of unseen frames above the least")
    return plot("modes-misfit", draw, labels, "Frames that no fit has seen", caption, "half", SIZE_IN)


def _change(numbers: NumberScan) -> Figure:
    change = np.array(numbers.change_nm)
    curves = {
        "change from the recommended number": np.where(change > 0, change, np.nan),
        "error from the difference of the halves": np.array(numbers.halves_nm),
    }

    def draw(axes: Axes) -> None:
        for marker, colour, (label, values) in zip(MARKERS, CYCLE, curves.items(), strict=False):
            axes.plot(numbers.highest_noll, values, f"{marker}-", color=colour, markersize=4, label=label)
        axes.axvline(numbers.recommended, color=INK, linewidth=0.8, linestyle=":")
        log_y(axes, *curves.values())

    caption = f"RMS of the difference in {REPORTED_TEXT}; modes that are not estimated count as zero."
    labels = ("highest Noll mode estimated", f"RMS in {REPORTED_TEXT} [nm]")
    return plot("modes-change", draw, labels, "Change of the estimate", caption, "half", SIZE_IN, "above")


def _table(numbers: NumberScan) -> Table:
    marks = {numbers.recommended: " *"}
    return Table.of(
        range(len(numbers.highest_noll)),
        {
            "Noll 2 to": lambda i: f"{numbers.highest_noll[i]}{marks.get(numbers.highest_noll[i], '')}",
            "χ²/ν unseen": lambda i: number(numbers.held_out_chi2_nu[i], ".3f"),
            "above the least": lambda i: with_error(numbers.excess[i], numbers.excess_sigma[i], "+.4f"),
            "χ²/ν fitted": lambda i: number(numbers.fitted_chi2_nu[i], ".2f"),
            f"change in {REPORTED_TEXT} [nm]": lambda i: number(numbers.change_nm[i]),
            "error from the halves [nm]": lambda i: number(numbers.halves_nm[i]),
        },
        "Number of modes",
        f"{plural(numbers.cubes, 'cube')}; *: recommended.",
    )


@dataclass(frozen=True)
class Points:
    """Standard deviations of the modes with their errors, and a law through them."""

    noll: np.ndarray
    std_nm: np.ndarray
    law_nm: np.ndarray | None = None
    sigma_nm: np.ndarray | None = None


def strength_plot(
    name: str, points: Mapping[str, Points], lines: Mapping[str, np.ndarray] | None = None
) -> Markup:
    """Draw standard deviations against Noll index, and `lines` of Noll index and value, each by its label."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        for place, (label, one) in enumerate(points.items()):
            colour = CYCLE[place % len(CYCLE)]
            look: dict[str, Any] = {"fmt": MARKERS[place % len(MARKERS)], "markersize": 3, "linewidth": 0.6}
            axes.errorbar(one.noll, one.std_nm, one.sigma_nm, color=colour, label=label, **look)
            if one.law_nm is not None:
                axes.plot(one.noll, one.law_nm, color=colour)
        for label, (noll, value_nm) in (lines or {}).items():
            axes.plot(noll, value_nm, "--", color=INK, linewidth=0.9, label=label)
        axes.set(xlabel="Noll index", ylabel="standard deviation [nm RMS]")
        log_y(axes, *(one.std_nm for one in points.values()))
        canvas.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)


# -- the derotator: maps at every angle, what turns and what does not --------------------------

FEW_COLUMNS = 3  # angles up to which a figure is narrow
ROWS = {
    "measured_nm": ("as measured", "As measured: on the detector"),
    "turned_back_nm": (
        "turned back",
        "turned back: in the frame before the derotator, where what turns stands still",
    ),
    "residual_nm": ("residual", "residual: measured minus the two parts"),
}
PARTS = {
    "rotating": ("turns with the derotator", "as at angle 0"),
    "fixed": ("does not turn", "behind the derotator"),
    "unsplit": ("cannot be split", "symmetric modes: sum of both"),
}
Series = StageData[DerotatorResults]


def derotator_section(run: RunData) -> Section:
    of = run.of(DerotatorResults)
    parts, cubes = of.results.parts, plural(len(of.results.cubes), "cube")
    if not parts:
        lead = (
            f"Nothing split: {of.results.reason}. What turns with the derotator shows only in recordings "
            "of two or more angles."
        )
        blocks = of.blocks(_maps, lambda of: Stack([_angles(of)]))
        return Section(of.stage, "Derotator test", lead, blocks)
    rotating, fixed = (number(parts[name].rms_nm, ".0f", "nm") for name in ("rotating", "fixed"))
    lead = f"{rotating} RMS turn with the derotator, {fixed} do not: {cubes}, each calibrated by itself."
    blocks = of.blocks(
        _maps,
        _parts_figure,
        lambda of: Stack([_parts(of), _consistency(of)]),
        lambda of: Stack([_angles(of), _coefficients(of)]),
    )
    return Section(of.stage, "Derotator test", lead, blocks)


def _maps(of: Series) -> list[Figure]:
    calibrate = of.run.of(CalibrateResults)
    names = [f"cubes/{cube.name}/mean_image_e" for cube in of.results.cubes]
    images = [calibrate[name] for name in names if name in calibrate.arrays]
    stackable = len({image.shape for image in images}) == 1 and len(images) == len(names)
    title = "Wavefront at every angle"
    return maps_figure(of.run, of.stage, title, np.stack(images) if stackable else None)


def maps_figure(
    run: RunData, stage: str, title: str, images: np.ndarray | None = None, prefix: str = ""
) -> list[Figure]:
    """Draw all angles in a row: image, estimate, estimate turned back, and what the parts leave of it.

    The `images` have shape (angles, rows, columns); `prefix` begins the names of the stage's arrays.
    """
    of = StageData(run, stage, StageResults())
    found = {name: f"{prefix}maps/{name}" for name in ROWS if f"{prefix}maps/{name}" in of.arrays}
    rows = {ROWS[name][0]: of[stored] for name, stored in found.items()}
    if not rows:
        return []
    titles = [f"{angle:g}°" for angle in of[f"{prefix}angle_deg"]]
    name = f"{stage}-{prefix}angles".replace("/", "-").replace("_", "-")
    drawing = wavefront_grid(name, titles, rows, common_limit_nm(*rows.values()), images)
    caption = "; ".join(ROWS[name][1] for name in found) + ". One scale; without tip and tilt."
    few: Width = "third" if len(titles) == 1 else "half"
    return [Figure(drawing, title, caption, few if len(titles) <= FEW_COLUMNS else "full")]


def _parts_figure(of: Series) -> Figure:
    parts, maps = of.results.parts or {}, np.stack([of[f"maps/{name}_nm"] for name in PARTS])
    titles = [f"{text}\n{number(parts[name].rms_nm, '.0f', 'nm RMS')}" for name, (text, _) in PARTS.items()]
    drawing = wavefront_grid("derotator-parts", titles, {"": maps}, common_limit_nm(maps))
    return Figure(drawing, "Parts of the wavefront", "The turning part as at angle 0.")


def _parts(of: Series) -> Table:
    results = of.results
    sense = (
        f"Sense of rotation: {results.sense} (χ² of the other sense {number(results.delta_chi2, '+.0f')}). "
        f"χ²/ν of the split {number(results.chi2_nu, '.2f')} for {results.freedom} degrees of freedom, "
        "against the errors of the single estimates."
    )
    rows = [
        (*PARTS[name], number(part.rms_nm), number(part.noise_nm), str(len(part.zernike_nm)))
        for name, part in (results.parts or {}).items()
    ]
    return Table(("part", "", "RMS [nm]", "of which errors [nm]", "modes"), rows, "Parts", sense)


def _consistency(of: Series) -> Table:
    found = of.results.consistency
    rows = [
        ("as measured", number(found.measured_nm)),
        ("turned back", number(found.turned_back_nm)),
        ("turned back, without the part that does not turn", number(found.without_fixed_nm)),
        ("expected from the errors of the estimates", number(found.expected_nm)),
    ]
    return Table(("difference between two angles", "mean RMS [nm]"), rows, "Consistency")


def _angles(of: Series) -> Table:
    results, measured = of.results, of.results.measured_nm
    left = results.residual_nm or [math.nan] * len(measured)
    angles = of["angle_deg"] if "angle_deg" in of.arrays else np.zeros(0)
    rows = [
        (cube.name, f"{angle:g}°", number(all_), number(rest))
        for cube, angle, all_, rest in zip(results.cubes, angles, measured, left, strict=True)
    ]
    columns = ("recording", "angle", "RMS [nm]", "residual [nm]")
    return Table(columns, rows, "Angles", "RMS over the disc, without tip and tilt.")


def _coefficients(of: Series) -> Table:
    parts = (of.results.parts or {}).items()
    nolls = sorted({noll for _, part in parts for noll in part.zernike_nm})
    rows = [
        (
            str(noll),
            *(with_error(part.zernike_nm.get(noll), part.sigma_nm.get(noll), "+.1f") for _, part in parts),
        )
        for noll in nolls
    ]
    columns = ("Noll", *(f"{PARTS[name][0]} [nm]" for name, _ in parts))
    return Table(columns, rows, "Coefficients of the parts", folded=True)
