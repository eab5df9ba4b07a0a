"""Quality control of stage `diagnose`: what is left unexplained needs a look."""

from __future__ import annotations

from irlos_pipe.diagnosis.verdict import UNKNOWN
from irlos_pipe.product.product import Check
from irlos_pipe.stages.diagnose.results import DiagnoseResults


def checks_of(results: DiagnoseResults) -> list[Check]:
    """Return the check of a diagnosis: that the model with what was named in `results` lacks nothing."""
    explained = results.verdict != UNKNOWN and not results.unexplained
    grade = f", {results.grade}" if results.grade and results.grade != results.verdict else ""
    message = f"{results.verdict}{grade}: {results.sentence}"
    return [Check("everything explained", float(explained), "", 1.0, None, message)]
