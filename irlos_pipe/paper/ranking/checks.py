"""What the results of the experiment `ranking` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.ranking.results import RankingResults, RankingRow
from irlos_pipe.product.product import Check


def checks_of(results: RankingResults) -> list[Check]:
    """Return the checks of the `results`: the default against the best of the others with any modes."""
    return [_first(row, results) for row in results.rows if row.method == DEFAULT]


def _first(default: RankingRow, results: RankingResults) -> Check:
    seeing, tail_nm = default.seeing_arcsec, default.tail_nm
    same = [row for row in results.rows if (row.seeing_arcsec, row.tail_nm) == (seeing, tail_nm)]
    best = min((row for row in same if row.method != DEFAULT), key=lambda row: row.best_nm)
    own_nm = list(default.modes.values())[-1].value
    return Check(
        f"default over the best of the others, {seeing:g} arcsec, tail {tail_nm:g} nm",
        own_nm / best.best_nm,
        "",
        None,
        1.0,
        f"medians {own_nm:.1f} nm, {best.label} {best.best_nm:.1f} nm",
    )
