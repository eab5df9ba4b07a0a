"""What the results of the experiment `focus_ramp` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.focus_ramp.results import FocusRampResults, VariantRow
from irlos_pipe.product.product import Check

ASKED_NM = 4.0  # RMS error of a calibrated ramp
SLOPE_WITHIN = 0.03  # of 1: the ramp's sign and scale
ASKED_OF = ("default_3", "default_9")
UNCALIBRATED = {
    "published_3": "none_3",
    "published_9": "none_9",
    "default_3": "none_3",
    "default_9": "none_9",
}


def checks_of(results: FocusRampResults) -> list[Check]:
    """Return the checks of the `results`: a calibration mends the ramp, the default's to what is asked."""
    ways = {row.key: row for row in results.ways}
    gains = [
        _gain(ways[one], ways[without])
        for one, without in UNCALIBRATED.items()
        if one in ways and without in ways
    ]
    asked = [ways[key] for key in ASKED_OF if key in ways]
    return [*gains, *map(_error, asked), *map(_slope, asked)]


def _gain(row: VariantRow, without: VariantRow) -> Check:
    error, before = row.true_rms_nm.median, without.true_rms_nm.median
    return Check(
        f"error with NCPAs over that without, {_of(row)}",
        error / before,
        "",
        None,
        1.0,
        f"medians {error:.1f} and {before:.1f} nm RMS",
    )


def _error(row: VariantRow) -> Check:
    error = row.true_rms_nm.median
    return Check(
        f"defocus error, {_of(row)}", error, "nm", None, ASKED_NM, f"median {error:.1f} nm RMS over the ramps"
    )


def _slope(row: VariantRow) -> Check:
    slope = row.slope.median
    return Check(f"slope, {_of(row)}", slope, "", 1 - SLOPE_WITHIN, 1 + SLOPE_WITHIN, f"median {slope:.3f}")


def _of(row: VariantRow) -> str:
    return f"{row.label}, {len(row.modes)} modes"
