"""What people see: messages on stderr, the table at the end on stdout."""

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from tqdm import tqdm

from irlos_pipe.conventions.text import aligned, printable
from irlos_pipe.files.json import json_text
from irlos_pipe.pipeline import Outcome, Step
from irlos_pipe.pipeline.runlog import ROOT, RUN, TRACE
from irlos_pipe.product.printed import PlannedStage


@contextmanager
def messages(verbosity: int) -> Iterator[None]:
    """Show log messages on stderr while the block lasts.

    `verbosity` is -1 for nothing, 0 for what the run does and warnings, 1 for all messages, 2 for debugging.
    """
    handler = _TerminalHandler(verbosity)
    level = ROOT.level
    ROOT.setLevel(logging.DEBUG if verbosity > 1 else logging.INFO)
    ROOT.addHandler(handler)
    try:
        yield
    finally:
        ROOT.removeHandler(handler)
        ROOT.setLevel(level)


def plan_text(steps: Sequence[Step], as_json: bool) -> str:
    """Return what a run would do by its `steps`, one line per stage, or a list with `as_json`."""
    if as_json:
        planned = [PlannedStage(stage=one.name, action=one.action.value, reason=one.reason) for one in steps]
        return json_text([one.as_json() for one in planned]).rstrip()
    return aligned([(step.name, step.action.value, step.reason) for step in steps])


def outcome_text(outcome: Outcome, as_json: bool) -> str:
    """Return the table at the end of a run with this `outcome`, or results.json with `as_json`."""
    if as_json:
        return json_text(outcome.results).rstrip()
    rows = [("NOTICE", outcome.results["notice"])] if "notice" in outcome.results else []
    rows += [(stage, line) for stage, lines in outcome.summary.items() for line in lines]
    rows.append(("QC", quality_line(outcome)))
    rows += [("", _check_text(check)) for check in outcome.quality["checks"] if not check["passed"]]
    if outcome.report is not None:
        rows.append(("report", str(outcome.report)))
    return aligned(rows)


def quality_line(outcome: Outcome) -> str:
    checks = outcome.quality["checks"]
    return f"{sum(check['passed'] for check in checks)} of {len(checks)} checks passed"


def _check_text(check: dict) -> str:
    ends = {">=": check["low"], "<=": check["high"]}
    limits = " and ".join(f"{sign} {limit:g}" for sign, limit in ends.items() if limit is not None)
    return (
        f"{check['stage']}: {check['name']} = {check['value']:g} {check['unit']} "
        f"should be {limits or 'a number'}; {check['message']}"
    )


class _TerminalHandler(logging.Handler):
    """Writes around progress bars; below -v only what the run does, and warnings of the stages."""

    def __init__(self, verbosity: int) -> None:
        super().__init__(logging.DEBUG)
        self._verbosity = verbosity

    def filter(self, record: logging.LogRecord) -> bool:
        if self._verbosity < 0 or record.name == TRACE.name:
            return False
        return self._verbosity > 0 or record.name == RUN.name or record.levelno >= logging.WARNING

    def emit(self, record: logging.LogRecord) -> None:
        prefix = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        with suppress(OSError, ValueError):  # a terminal that is gone, or a full disk, stops no run
            tqdm.write(f"irlos: {prefix}{printable(record.getMessage())}", file=sys.stderr)
