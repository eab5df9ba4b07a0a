"""What the results of the experiment `capture` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.capture.results import CaptureResults
from irlos_pipe.product.product import Check


def checks_of(results: CaptureResults) -> list[Check]:
    """Return the check of the `results`: the default, the last start, finds all within the required range."""
    required = results.starts[-1].required
    missed = required.cases - required.captured
    text = f"{missed} of {required.cases} cases were not found by the default"
    return [Check("defocus not found within the required range", missed, "", None, 0, text)]
