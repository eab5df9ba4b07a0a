"""Parameters of effects as a table for people has them: words, and the unit in a column of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.report.text import MISSING, number, rounded_by_error

UNITS = {
    "mas_per_um": "mas/µm",
    "nm_per_um": "nm/µm",
    "e_per_pixel": "e⁻/px",
    "nm": "nm",
    "mas": "mas",
    "deg": "°",
    "m": "m",
}
WORDS = {
    "sigma": "σ",
    "sep": "separation",
    "pa": "position angle",
    "wfe": "wavefront error",
    "in_band_wfe": "wavefront error in the band",
    "rms": "RMS",
    "piston_rms": "piston RMS",
    "slopes_rms": "tip and tilt RMS",
    "stretch_angle": "angle of the stretch",
    "": "size",
}
PARTS_OF_ONE = ("flux_ratio", "fraction", "fraction_at_peak")
MOST_ROWS = 16  # of one effect; tables of modes and petals have more


class Row(NamedTuple):
    """A parameter: what it is called, value with error, and unit."""

    name: str
    value: str
    unit: str


def parameter_rows(public: Mapping[str, Any], sigma: Mapping[str, Any] | None = None) -> list[Row]:
    """Return rows for all numbers of `public` values with their errors `sigma`."""
    pixels = [Row("pixel", f"row {row}, column {column}", "") for row, column in public.get("pixels", [])]
    others = {key: value for key, value in public.items() if key != "pixels"}
    errors = dict(rows_of(sigma or {}))
    return [*pixels, *(_row(name, value, errors.get(name)) for name, value in rows_of(others))]


def worded(name: str) -> tuple[str, str]:
    """Return label and unit of a public name such as ``sep_mas`` or ``piston_nm_from_mean 2``."""
    head, _, index = name.partition(" ")
    plain = head.removesuffix("_from_mean")
    fits = [suffix for suffix in UNITS if f"_{plain}".endswith(f"_{suffix}")]
    suffix = max(fits, key=len, default="")
    label = plain.removesuffix(suffix).removesuffix("_") if suffix else plain
    label = WORDS.get(label, label.replace("_", " "))
    if label == "zernike":
        label = "Noll"
    apart = " − mean" if plain != head else ""
    return f"{label} {index}".strip() + apart, "%" if plain in PARTS_OF_ONE else UNITS.get(suffix, "")


def sizes(public: Mapping[str, Any]) -> str:
    """Return `public` values without errors in one line."""
    return in_one_line([Row(*_plain(name, value)) for name, value in rows_of(public)])


def in_one_line(rows: Sequence[Row]) -> str:
    """Return names, values and units of `rows`, with commas between the rows."""
    return ", ".join(" ".join(filter(None, row)) for row in rows)


def shortened(rows: Sequence[Row]) -> list[Row]:
    """Return what of `rows` a table shows at once, the last one saying how many more there are."""
    if len(rows) <= MOST_ROWS:
        return [*rows]
    return [*rows[: MOST_ROWS // 2], Row(f"… {len(rows) - MOST_ROWS // 2} more, below", "", "")]


def _row(name: str, value: Any, error: float | None) -> Row:
    label, unit = worded(name)
    if not isinstance(value, float):
        return Row(label, MISSING if value is None else str(value), unit)
    factor = 100.0 if unit == "%" else 1.0
    return Row(label, rounded_by_error(factor * value, None if error is None else factor * error), unit)


def _plain(name: str, value: Any) -> tuple[str, str, str]:
    label, unit = worded(name)
    return label, number((100.0 if unit == "%" else 1.0) * value, ".2g"), unit
