"""Figures and tables of a derotator series, measured or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from irlos_pipe.report.content import Figure, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, with_error
from irlos_pipe.report.wavefront_plots import FEW_COLUMNS, common_limit_nm, wavefront_grid

ROWS = {"measured_nm": "as measured", "turned_back_nm": "turned back", "residual_nm": "residual"}
PARTS = {
    "rotating": ("turns with the derotator", "as at angle 0"),
    "fixed": ("does not turn", "behind the derotator"),
    "unsplit": ("cannot be split", "symmetric modes: sum of both"),
}


def angle_titles(run: RunData, stage: str, prefix: str = "") -> list[str]:
    """Derotator angles as titles of columns."""
    angles = run.array(stage, f"{prefix}angle_deg")
    return [f"{angle:g}°" for angle in (() if angles is None else angles)]


def maps_figure(
    run: RunData, stage: str, title: str, images: np.ndarray | None = None, prefix: str = ""
) -> list[Figure]:
    """All angles in a row: image, estimate, estimate turned back, and what the parts leave of it."""
    rows = {text: run.array(stage, f"{prefix}maps/{name}") for name, text in ROWS.items()}
    rows = {text: maps for text, maps in rows.items() if maps is not None}
    titles = angle_titles(run, stage, prefix)
    if not rows:
        return []
    drawing = wavefront_grid(
        _name(stage, prefix, "angles"), titles, rows, common_limit_nm(*rows.values()), images
    )
    told = {
        "as measured": "As measured: on the detector",
        "turned back": "turned back: in the frame before the derotator, where what turns stands still",
        "residual": "residual: measured minus the two parts",
    }
    caption = "; ".join(told[text] for text in rows) + ". One scale; without tip and tilt."
    return [Figure(drawing, title, caption, _width(len(titles)))]


def parts_figure(run: RunData, stage: str, parts: dict[str, Any], prefix: str = "") -> list[Figure]:
    """Draw the parts side by side with their RMS."""
    found = {name: run.array(stage, f"{prefix}maps/{name}_nm") for name in PARTS}
    if any(one is None for one in found.values()):
        return []
    titles = [f"{PARTS[name][0]}\n{number(parts[name].get('rms_nm'), '.0f', 'nm RMS')}" for name in found]
    maps = np.stack(list(found.values()))
    drawing = wavefront_grid(_name(stage, prefix, "parts"), titles, {"": maps}, common_limit_nm(maps))
    return [Figure(drawing, "Parts of the wavefront", "The turning part as at angle 0.", "half")]


def parts_table(results: dict[str, Any]) -> Table:
    """Tabulate the parts."""
    rows = [
        (*PARTS[name], number(part.get("rms_nm")), number(part.get("noise_nm")), str(len(part["zernike_nm"])))
        for name, part in results["parts"].items()
    ]
    columns = ("part", "", "RMS [nm]", "of which errors [nm]", "modes")
    return Table(columns, rows, "Parts", _sense(results))


def _sense(results: dict[str, Any]) -> str:
    delta = number(results.get("delta_chi2"), "+.0f")
    return (
        f"Sense of rotation: {results.get('sense')} (χ² of the other sense {delta}). χ²/ν of the split "
        f"{number(results.get('chi2_nu'), '.2f')} for {results.get('freedom')} degrees of freedom, "
        "against the errors of the single estimates."
    )


def consistency_table(results: dict[str, Any]) -> Table:
    """Tabulate how well the angles agree."""
    found = results.get("consistency") or {}
    texts = {
        "measured_nm": "as measured",
        "turned_back_nm": "turned back",
        "without_fixed_nm": "turned back, without the part that does not turn",
        "expected_nm": "expected from the errors of the estimates",
    }
    rows = [(text, number(found.get(key))) for key, text in texts.items()]
    return Table(("difference between two angles", "mean RMS [nm]"), rows, "Consistency")


def angles_table(
    names: Sequence[str],
    titles: Sequence[str],
    results: dict[str, Any],
    further: dict[str, Sequence[str]] | None = None,
) -> Table:
    """Tabulate the angles; `further` holds more columns of text."""
    further = further or {}
    measured = results.get("measured_nm", [])
    left = results.get("residual_nm", [None] * len(measured))
    rows = [
        (name, title, number(all_), number(rest), *more)
        for name, title, all_, rest, *more in zip(
            names, titles, measured, left, *further.values(), strict=True
        )
    ]
    columns = ("recording", "angle", "RMS [nm]", "residual [nm]", *further)
    return Table(columns, rows, "Angles", "RMS over the disc, without tip and tilt.")


def coefficients_table(parts: dict[str, Any]) -> Table:
    """Tabulate the coefficients of the parts, folded."""
    nolls = sorted({int(noll) for part in parts.values() for noll in part["zernike_nm"]})
    rows = [
        (
            str(noll),
            *(
                with_error(part["zernike_nm"].get(str(noll)), part["sigma_nm"].get(str(noll)), "+.1f")
                for part in parts.values()
            ),
        )
        for noll in nolls
    ]
    columns = ("Noll", *(f"{PARTS[name][0]} [nm]" for name in parts))
    return Table(columns, rows, "Coefficients of the parts", folded=True)


def _width(columns: int) -> str:
    return "third" if columns == 1 else "half" if columns <= FEW_COLUMNS else "full"


def _name(stage: str, prefix: str, what: str) -> str:
    return f"{stage}-{prefix}{what}".replace("/", "-").replace("_", "-")
