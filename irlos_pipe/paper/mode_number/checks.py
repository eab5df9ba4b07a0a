"""What the results of the experiment `mode_number` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.common.variants import PAPER_CHOICE
from irlos_pipe.paper.mode_number.results import ModeNumberResults, NumberCurve
from irlos_pipe.product.product import Check


def checks_of(results: ModeNumberResults) -> list[Check]:
    """Return the checks of the `results`: DIP is best at the number introduced, which the frames tell."""
    published = [curve for curve in results.curves if curve.method == PAPER_CHOICE]
    return [*(_best(results, curve) for curve in published), _recommended(results)]


def _best(results: ModeNumberResults, curve: NumberCurve) -> Check:
    """The paper's appendix B."""
    last = results.modes_introduced + 1
    return Check(
        f"modes from those introduced to DIP global's best, m_J {curve.mag_j:g}",
        abs(curve.best_noll - last),
        "",
        None,
        0,
        f"best to Noll {curve.best_noll}, introduced to Noll {last}",
    )


def _recommended(results: ModeNumberResults) -> Check:
    last = results.modes_introduced + 1
    others = sum(one != last for one in results.recommended_noll)
    return Check(
        "cubes whose held-out frames choose another number than the introduced one",
        others,
        "",
        None,
        results.cubes / 2,
        f"{others} of {results.cubes}",
    )
