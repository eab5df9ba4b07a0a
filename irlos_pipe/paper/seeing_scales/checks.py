"""What the results of the experiment `seeing_scales` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.seeing_scales.results import SeeingScalesResults
from irlos_pipe.product.product import Check

WITHIN = 0.02  # some six standard errors of the median of 20 000 draws


def checks_of(results: SeeingScalesResults) -> list[Check]:
    """Return the checks of the `results`: SPARTA's seeing is, in the median, that of the relation."""
    drawn = results.distributions
    expected_arcsec = results.relation.scale.to_sparta(drawn.monitor_arcsec.median)
    ratio = drawn.sparta_arcsec.median / expected_arcsec
    return [
        Check(
            "SPARTA's median seeing over that of the relation",
            ratio,
            "",
            1 - WITHIN,
            1 + WITHIN,
            f"{drawn.sparta_arcsec.median:.3f} and {expected_arcsec:.3f} arcsec",
        )
    ]
