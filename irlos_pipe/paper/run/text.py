"""The table at the end of `irlos paper`."""

from __future__ import annotations

from irlos_pipe.conventions.text import aligned
from irlos_pipe.paper.run.run import Ran
from irlos_pipe.pipeline import Outcome
from irlos_pipe.pipeline.terminal import quality_line


def ran_text(ran: Ran) -> str:
    """Return the summary lines of every experiment and where the files are."""
    rows = [(name, line) for name, outcome in ran.outcomes.items() for line in _lines(outcome)]
    rows += [(name, f"failed: {problem}") for name, problem in ran.problems.items()]
    rows += [("report", str(ran.report)), ("numbers", str(ran.results))]
    return aligned(rows)


def _lines(outcome: Outcome) -> list[str]:
    quality = f", {quality_line(outcome)}" if outcome.quality["checks"] else ""
    told = [line for lines in outcome.summary.values() for line in lines]
    return [outcome.status.replace("_", " ") + quality, *told]
