"""What the results of the experiment `first_tests` have to keep."""

from __future__ import annotations

import numpy as np
from scipy import stats

from irlos_pipe.paper.first_tests.results import FirstTestsResults, TargetRow
from irlos_pipe.product.product import Check

DEFAULT_WAY = "default_3"
BY_CHANCE = 1e-3  # probability with which right errors give a larger pull


def checks_of(results: FirstTestsResults) -> list[Check]:
    """Return the checks of the `results`: the default finds the focus stage's error, from its own start."""
    return [check for row in results.targets for check in (_stage_error(row), _wrong(row))]


def _stage_error(row: TargetRow) -> Check:
    found = row.variant(DEFAULT_WAY)
    ramps = len(found.stage_found_nm)
    return Check(
        f"pull of the focus stage's error, {row.label}",
        found.pull,
        "",
        None,
        float(np.sqrt(stats.chi2.isf(BY_CHANCE, ramps) / ramps)),
        f"{found.pull:.1f}, RMS over {ramps} ramps, of an introduced error of {found.stage_true_nm:g} nm",
    )


def _wrong(row: TargetRow) -> Check:
    (start,) = (one for one in row.starts if (one.way, one.start) == (DEFAULT_WAY, "default"))
    return Check(
        f"frames in a wrong minimum, {row.label}",
        start.wrong,
        "",
        None,
        0,
        f"{start.wrong} of {start.frames} frames of the default",
    )
