"""What the results of the experiment `mode_statistics` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.mode_statistics.results import ModeStatisticsResults
from irlos_pipe.product.product import Check

TRUTH = "introduced"
TERMS = {"A": ("A_nm", "A_sigma_nm"), "B": ("B", "B_sigma"), "C": ("C_nm", "C_sigma_nm")}


def checks_of(results: ModeStatisticsResults) -> list[Check]:
    """Return the checks of the `results`: the default finds the law, each term within its standard error."""
    return [_term(results, term) for term in TERMS]


def _term(results: ModeStatisticsResults, term: str) -> Check:
    """Both laws are fitted to the same draws, so they differ by less than a fit's error, which is theirs."""
    found, true = (results.laws_of_introduced_modes[name] for name in (DEFAULT, TRUTH))
    value, sigma = (getattr(found, name) for name in TERMS[term])
    introduced = getattr(true, TERMS[term][0])
    return Check(
        f"law of the default, term {term}: deviation over standard error",
        abs(value - introduced) / sigma,
        "",
        None,
        1.0,
        f"{value:.3g} ± {sigma:.2g}, introduced {introduced:.3g}",
    )
