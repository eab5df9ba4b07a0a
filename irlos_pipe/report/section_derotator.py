"""Section on the derotator test: maps at every angle, what turns and what does not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Width
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error
from irlos_pipe.report.wavefront_plots import FEW_COLUMNS, common_limit_nm, wavefront_grid
from irlos_pipe.stages.derotator import DerotatorResults, PartRow, SplitRow

STAGE = "derotator"
ROWS = {"measured_nm": "as measured", "turned_back_nm": "turned back", "residual_nm": "residual"}
PARTS = {
    "rotating": ("turns with the derotator", "as at angle 0"),
    "fixed": ("does not turn", "behind the derotator"),
    "unsplit": ("cannot be split", "symmetric modes: sum of both"),
}


def derotator_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(DerotatorResults)
    names = [cube.name for cube in results.cubes]
    angles = angles_table(names, angle_titles(run, STAGE), results)
    blocks: list[Block] = []
    blocks += maps_figure(run, STAGE, "Wavefront at every angle", _images(run, names))
    if results.parts:
        blocks += [
            *parts_figure(run, STAGE, results.parts),
            Stack([parts_table(results), consistency_table(results)]),
            Stack([angles, coefficients_table(results.parts)]),
        ]
    else:
        blocks.append(Stack([angles]))
    return Section(STAGE, "Derotator test", _lead(results), blocks)


def _images(run: RunData, names: Sequence[str]) -> np.ndarray | None:
    found = [run.array("calibrate", f"cubes/{name}/mean_image_e") for name in names]
    images = [image for image in found if image is not None]
    alike = len({image.shape for image in images}) == 1
    return np.stack(images) if alike and len(images) == len(found) else None


def _lead(results: DerotatorResults) -> str:
    if not results.parts:
        return (
            f"Nothing split: {results.reason}. What turns with the derotator shows only in recordings "
            "of two or more angles."
        )
    parts, cubes = results.parts, plural(len(results.cubes), "cube")
    rotating, fixed = (number(parts[name].rms_nm, ".0f", "nm") for name in ("rotating", "fixed"))
    return f"{rotating} RMS turn with the derotator, {fixed} do not: {cubes}, each calibrated by itself."


# -- blocks, also of a simulated series --------------------------------------------------------


def angle_titles(run: RunData, stage: str, prefix: str = "") -> list[str]:
    """Return the angles of a `run` as titles of columns; arrays of the `stage` begin with `prefix`."""
    angles = run.array(stage, f"{prefix}angle_deg")
    return [f"{angle:g}°" for angle in (() if angles is None else angles)]


def maps_figure(
    run: RunData, stage: str, title: str, images: np.ndarray | None = None, prefix: str = ""
) -> list[Figure]:
    """Draw all angles in a row: image, estimate, estimate turned back, and what the parts leave of it.

    Parameters
    ----------
    run : RunData
    stage : str
    title : str
        Title of the figure.
    images : ndarray, (angles, rows, columns), optional
    prefix : str
        Begin of the names of the stage's arrays.
    """
    stored = {text: run.array(stage, f"{prefix}maps/{name}") for name, text in ROWS.items()}
    rows = {text: maps for text, maps in stored.items() if maps is not None}
    titles = angle_titles(run, stage, prefix)
    if not rows:
        return []
    drawing = wavefront_grid(
        _name(stage, prefix, "angles"), titles, rows, common_limit_nm(*rows.values()), images
    )
    captions = {
        "as measured": "As measured: on the detector",
        "turned back": "turned back: in the frame before the derotator, where what turns stands still",
        "residual": "residual: measured minus the two parts",
    }
    caption = "; ".join(captions[text] for text in rows) + ". One scale; without tip and tilt."
    return [Figure(drawing, title, caption, _width(len(titles)))]


def parts_figure(run: RunData, stage: str, parts: Mapping[str, PartRow], prefix: str = "") -> list[Figure]:
    """Draw the parts side by side with their RMS.

    Parameters
    ----------
    run : RunData
    stage : str
    parts : mapping of str to PartRow
    prefix : str
        Begin of the names of the stage's arrays.
    """
    stored = {name: run.array(stage, f"{prefix}maps/{name}_nm") for name in PARTS}
    found = {name: maps for name, maps in stored.items() if maps is not None}
    if len(found) < len(PARTS):
        return []
    titles = [f"{PARTS[name][0]}\n{number(parts[name].rms_nm, '.0f', 'nm RMS')}" for name in found]
    maps = np.stack(list(found.values()))
    drawing = wavefront_grid(_name(stage, prefix, "parts"), titles, {"": maps}, common_limit_nm(maps))
    return [Figure(drawing, "Parts of the wavefront", "The turning part as at angle 0.", "half")]


def parts_table(results: SplitRow) -> Table:
    """Tabulate the parts."""
    rows = [
        (*PARTS[name], number(part.rms_nm), number(part.noise_nm), str(len(part.zernike_nm)))
        for name, part in (results.parts or {}).items()
    ]
    columns = ("part", "", "RMS [nm]", "of which errors [nm]", "modes")
    return Table(columns, rows, "Parts", _sense(results))


def _sense(results: SplitRow) -> str:
    delta = number(results.delta_chi2, "+.0f")
    return (
        f"Sense of rotation: {results.sense} (χ² of the other sense {delta}). χ²/ν of the split "
        f"{number(results.chi2_nu, '.2f')} for {results.freedom} degrees of freedom, "
        "against the errors of the single estimates."
    )


def consistency_table(results: SplitRow) -> Table:
    """Tabulate how well the angles agree."""
    found = results.consistency
    rows = [
        ("as measured", number(found.measured_nm)),
        ("turned back", number(found.turned_back_nm)),
        ("turned back, without the part that does not turn", number(found.without_fixed_nm)),
        ("expected from the errors of the estimates", number(found.expected_nm)),
    ]
    return Table(("difference between two angles", "mean RMS [nm]"), rows, "Consistency")


def angles_table(
    names: Sequence[str],
    titles: Sequence[str],
    results: SplitRow,
    further: Mapping[str, Sequence[str]] | None = None,
) -> Table:
    """Tabulate the angles.

    Parameters
    ----------
    names, titles : sequence of str
        Recordings, and their angles as text.
    results : SplitRow
    further : mapping of str to sequence of str, optional
        More columns of text, by their title.
    """
    further = further or {}
    measured = results.measured_nm
    left = results.residual_nm or [math.nan] * len(measured)
    rows = [
        (name, title, number(all_), number(rest), *more)
        for name, title, all_, rest, *more in zip(
            names, titles, measured, left, *further.values(), strict=True
        )
    ]
    columns = ("recording", "angle", "RMS [nm]", "residual [nm]", *further)
    return Table(columns, rows, "Angles", "RMS over the disc, without tip and tilt.")


def coefficients_table(parts: Mapping[str, PartRow]) -> Table:
    """Tabulate the coefficients of the parts, folded."""
    nolls = sorted({noll for part in parts.values() for noll in part.zernike_nm})
    rows = [
        (
            str(noll),
            *(
                with_error(part.zernike_nm.get(noll), part.sigma_nm.get(noll), "+.1f")
                for part in parts.values()
            ),
        )
        for noll in nolls
    ]
    columns = ("Noll", *(f"{PARTS[name][0]} [nm]" for name in parts))
    return Table(columns, rows, "Coefficients of the parts", folded=True)


def _width(columns: int) -> Width:
    return "third" if columns == 1 else "half" if columns <= FEW_COLUMNS else "full"


def _name(stage: str, prefix: str, what: str) -> str:
    return f"{stage}-{prefix}{what}".replace("/", "-").replace("_", "-")
