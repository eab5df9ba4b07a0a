"""Numbers, modes and parameters of effects as text for people; what is missing becomes a dash."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

from markupsafe import Markup

from irlos_pipe.conventions import text
from irlos_pipe.effects.base import kind_of
from irlos_pipe.effects.catalogue import CATALOGUE
from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.optics.zernike import noll_to_nm

MISSING = "–"
FAMILIES = {
    0: "spherical",
    1: "coma",
    2: "astigmatism",
    3: "trefoil",
    4: "quadrafoil",
    5: "pentafoil",
    6: "hexafoil",
}
LOW_ORDER = {1: "piston", 2: "tilt x", 3: "tilt y", 4: "defocus"}
# Modes of an azimuthal order that have names of their own, before the family begins.
NAMED_APART = {0: 2, 1: 1}
ORDINALS = ("", "2nd ", "3rd ", "4th ", "5th ", "6th ")
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
MEANING = "meaning-"  # begins the names of the rows that explain a number or an effect
MOST_ROWS = 16  # rows of one effect that are shown at once; tables of modes and petals have more


def is_known(value: float | None) -> TypeGuard[float]:
    """Return whether a number is there and finite."""
    return value is not None and math.isfinite(value)


def number(value: float | None, pattern: str = ".1f", unit: str = "") -> str:
    """Format `value` by `pattern` with its `unit`; None, NaN and infinity give a dash."""
    if not is_known(value):
        return MISSING
    if not (pattern.endswith("d") or "," in pattern):  # with ``z`` what rounds to zero has no sign
        sign = pattern[:1] if pattern[:1] in "+-" else ""
        pattern = f"{sign}z{pattern.removeprefix(sign)}"
    return f"{value:{pattern}}" + (f" {unit}" if unit else "")


def with_error(value: float | None, error: float | None, pattern: str = ".1f", unit: str = "") -> str:
    """Format `value` ± `error` by `pattern` with its `unit`; the value alone without an error."""
    if not is_known(value) or not is_known(error):
        return number(value, pattern, unit)
    return f"{number(value, pattern)} ± {number(error, pattern.lstrip('+'))}" + (f" {unit}" if unit else "")


def rounded_by_error(value: float, error: float | None) -> str:
    """Format `value` ± `error` to the second digit of the error; four digits without an error."""
    if not is_known(value) or not is_known(error):
        return number(value, ".4g")
    return text.rounded_by_error(value, error, ".4g")


def plural(count: int, noun: str) -> str:
    """Format a `count` with its `noun`: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def duration(seconds: float | None) -> str:
    """Format a time to two units: ``4.2 s``, ``3 min 20 s``, ``2 h 05 min``."""
    if not is_known(seconds):
        return MISSING
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def mode_name(noll: int) -> str:
    """Return the name of a mode: ``coma x``, ``2nd astigmatism 45°``.

    Odd azimuthal orders end in the axis they lie along, even ones in the angle of their first
    maximum from +x.
    """
    if noll in LOW_ORDER:
        return LOW_ORDER[noll]
    n, m = noll_to_nm(noll)
    family = FAMILIES.get(abs(m), f"{abs(m)}-foil")
    order = (n - abs(m)) // 2 - NAMED_APART.get(abs(m), 0)
    return f"{ORDINALS[order] if order < len(ORDINALS) else f'{order + 1}th '}{family}{_direction(m)}"


def mode_label(noll: int) -> str:
    """Return Noll index and name: ``4 defocus``."""
    return f"{noll} {mode_name(noll)}"


def _direction(m: int) -> str:
    if m == 0:
        return ""
    if m % 2:
        return " x" if m > 0 else " y"
    return " 0°" if m > 0 else f" {90 / -m:g}°"


# -- parameters of effects ---------------------------------------------------------------------


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
    rows = [(*worded(name), value) for name, value in rows_of(public)]
    return in_one_line(
        [
            Row(label, number((100.0 if unit == "%" else 1.0) * value, ".2g"), unit)
            for label, unit, value in rows
        ]
    )


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


def effect_link(label: str) -> str:
    """Return the readable name of an effect with a link to what it is; other text as it is."""
    kind = kind_of(label)
    if kind not in CATALOGUE:
        return label
    return Markup('<a href="#{}{}">{}</a>').format(MEANING, kind, label.replace("_", " "))
