"""What no input may ever bring about."""

import os
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from click.testing import CliRunner, Result
from helpers.patience import Hang, within

from fuzz import pristine
from fuzz.case import Case, draw
from fuzz.guard import GIB, limited_memory, nights_in_this_process, witnessed_writes
from irlos_pipe.commands.main import cli
from irlos_pipe.conventions.errors import IrlosError

DOCUMENTED = {0, 2, 3, 4, 5, 64}
OF_THE_PLACE = {1, 75}  # what cannot be written, or is in use
MEMORY = 2 * GIB
TIME_S = 30.0  # of the processor, or twenty times that by the clock: the machine may be busy
PRODUCT = "01_ingest.h5"
TOLERATED = 0.02  # of the peak: what the noise of single pixels may hide
FLAGS = ("warning", "rejected", "missing", "bad pixels")


@dataclass(frozen=True)
class Verdict:
    """How a case ended."""

    kind: str
    seed: int
    summary: str
    exit_code: int
    finding: str  # what must not happen; empty if all is well
    compared: bool = False  # whether the result was compared with that of the unspoiled input


def judged(kind: str, seed: int) -> Verdict:
    """Make a case, run it under limits, and judge what came of it."""
    with tempfile.TemporaryDirectory(prefix="irlos-fuzz-") as place:
        return _judged(kind, seed, Path(place))


def _judged(kind: str, seed: int, folder: Path) -> Verdict:
    with nights_in_this_process():
        case = draw(kind, seed, folder)
        before = _listing(folder)
        result, writes = _run(case)
    finding = result if isinstance(result, str) else _finding(case, result, folder)
    finding = finding or _strays(folder, before, writes)
    code = -1 if isinstance(result, str) else result.exit_code
    compared = code == 0 and bool(case.reference) and (folder / "out" / PRODUCT).exists()
    return Verdict(kind, seed, case.summary, code, finding, compared)


def _run(case: Case) -> tuple[Result | str, list[str]]:
    """Run the command; returns its result, or what stopped it, and what it wrote."""
    with witnessed_writes() as writes:
        try:
            with limited_memory(MEMORY), within(TIME_S, patience=20):
                return CliRunner().invoke(cli, case.arguments), writes
        except Hang:
            return f"hang: more than {TIME_S:.0f} s of the processor", writes


def _finding(case: Case, result: Result, folder: Path) -> str:
    """Return what is wrong with the end of a command."""
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return "traceback: " + "".join(traceback.format_exception(result.exception))[-600:]
    if "Traceback" in result.output or "irlos: error: unexpected" in result.output:
        return f"unexpected error: {result.output[-400:]}"
    if result.exit_code not in (DOCUMENTED | OF_THE_PLACE if case.place else DOCUMENTED):
        return f"exit code {result.exit_code}: {result.output[-400:]}"
    return _wrong_messages(result) or _silently_wrong(case, result, folder)


def _wrong_messages(result: Result) -> str:
    """Errors are reported in lines of their own; bad data in exactly one."""
    lines = [line for line in result.output.splitlines() if line.startswith("irlos: error: ")]
    if result.exit_code in (1, 3, 64, 75) and len(lines) != 1:
        return f"{len(lines)} error lines for one problem: {result.output[-400:]}"
    if result.exit_code == 2 and not lines and "Error: " not in result.output:
        return f"no reason given: {result.output[-400:]}"
    return ""


def _silently_wrong(case: Case, result: Result, folder: Path) -> str:
    """Return how a result that nobody warns of differs from that of the unspoiled input."""
    product = folder / "out" / PRODUCT
    if not case.reference or result.exit_code != 0 or not product.exists() or case.plausible:
        return ""
    if any(flag in result.output for flag in FLAGS):
        return ""
    try:
        ours, true = pristine.measured(product), pristine.reference(case.reference)
    except IrlosError:
        return ""  # whoever reads it gets an error
    if ours.mean_e.shape != true.mean_e.shape:
        return f"silently another window: {ours.mean_e.shape}"
    good = ours.mask & true.mask
    worst = float(np.max(np.abs(ours.mean_e - true.mean_e)[good]) / true.mean_e.max())
    return f"silently wrong by {worst:.1%} of the peak" if worst > TOLERATED else ""


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file of a case outside its output."""
    files = [
        Path(where, name)
        for where, folders, names in os.walk(folder)  # no link is followed
        for name in (*folders, *names)
        if Path(where, name).relative_to(folder).parts[0] != "out"
    ]
    return {str(path): (path.lstat().st_size, path.lstat().st_mtime_ns) for path in files}


def _strays(folder: Path, before: dict, writes: list[str]) -> str:
    """Return what was written or changed outside the output folder."""
    changed = [path for path, state in _listing(folder).items() if before.get(path) != state]
    lost = before.keys() - _listing(folder).keys()
    allowed = (str(folder / "out"), os.devnull)
    outside = [path for path in writes if not path.startswith(allowed) and not path.endswith(".log")]
    found = [path for path in [*changed, *lost, *outside] if not Path(path).is_dir() or path in lost]
    return f"written outside the output folder: {', '.join(found[:3])}" if found else ""
