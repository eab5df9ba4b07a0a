"""What the results of the experiment `exposures` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.exposures.results import ExposuresResults, MethodRow
from irlos_pipe.product.product import Check

STEADY = 1.5  # the default may change by so much from one exposure to another: it fits the mean image


def checks_of(results: ExposuresResults) -> list[Check]:
    """Return the checks of the `results`: the exposure does not matter to the default."""
    return [_steady(row) for row in results.rows if row.method == DEFAULT]


def _steady(row: MethodRow) -> Check:
    medians = [one.median for one in row.modes_nm]
    return Check(
        f"default's worst over its best exposure, {row.seeing_arcsec:g} arcsec",
        max(medians) / min(medians),
        "",
        None,
        STEADY,
        f"medians from {min(medians):.1f} to {max(medians):.1f} nm",
    )
