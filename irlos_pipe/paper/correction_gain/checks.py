"""What the results of the experiment `correction_gain` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, PAPER_CHOICE
from irlos_pipe.paper.correction_gain.results import CorrectionGainResults, SeeingRow
from irlos_pipe.product.product import Check

BEFORE = "before"


def checks_of(results: CorrectionGainResults) -> list[Check]:
    """Return the checks of the `results`: every correction sharpens the star, the default's not less."""
    gains = [_gain(row, method) for row in results.seeings for method in (DEFAULT, PAPER_CHOICE)]
    return [*gains, *map(_order, results.seeings)]


def _gain(row: SeeingRow, method: str) -> Check:
    before, after = row.strehl[BEFORE], row.strehl[method]
    return Check(
        f"gain in Strehl ratio by {METHOD_NAMES[method]}, {row.seeing_arcsec:g} arcsec",
        after / before,
        "",
        1.0,
        None,
        f"from {before:.3f} to {after:.3f}, median of {row.samples} stars",
    )


def _order(row: SeeingRow) -> Check:
    default, published = row.strehl[DEFAULT], row.strehl[PAPER_CHOICE]
    return Check(
        f"Strehl ratio by the default over that by DIP global, {row.seeing_arcsec:g} arcsec",
        default / published,
        "",
        1.0,
        None,
        f"{default:.3f} and {published:.3f}",
    )
