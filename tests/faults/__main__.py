"""``PYTHONPATH=tests python -m faults --kills 100``: kill runs, fill their disks, and see what is left."""

import argparse
import multiprocessing
import shutil
import signal
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

from faults.harness import Harness, after_harm
from faults.runs import End, signalled

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
KILL, DISK, SIGNAL, WRITER = "kill -9", "full disk", "signal", "beside a writer"
SMALLEST_BYTES = 100
Harm = tuple[str, int, float]  # name, number, where within its range: 0 to 1
Suffered = tuple[str, int, list[str]]  # name, how the run ended, all that was wrong


def main() -> int:
    """Return 1 if anything was left that must not be."""
    options = _options()
    harms, found = _harms(options), []
    with tempfile.TemporaryDirectory(prefix="irlos-faults-") as place:
        # After a writer the recordings have other times: the others come first, in other processes.
        for late in (False, True):
            found += _suffer([one for one in harms if (one[0] == WRITER) == late], Path(place), options.jobs)
    print(_table(found))
    return int(any(problems for _, _, problems in found))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="kill -9 at so many random moments")
    parser.add_argument("--disks", type=int, default=50, help="full disks, at so many random sizes")
    parser.add_argument("--signals", type=int, default=30, help="SIGTERM, SIGHUP and SIGINT in turn")
    parser.add_argument(
        "--writers", type=int, default=10, help="runs beside a program that writes recordings"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    return parser.parse_args()


def _harms(options: argparse.Namespace) -> list[Harm]:
    counts = {KILL: options.kills, DISK: options.disks, SIGNAL: options.signals, WRITER: options.writers}
    drawn = {
        name: np.random.default_rng([options.seed, place]).uniform(size=count)
        for place, (name, count) in enumerate(counts.items())
    }
    return [(name, number, float(at)) for name, some in drawn.items() for number, at in enumerate(some)]


def _suffer(harms: list[Harm], place: Path, jobs: int) -> list[Suffered]:
    """Bring all harms about, printing problems at once."""
    found = []
    with multiprocessing.get_context("fork").Pool(max(1, min(jobs, len(harms))), _begin, (place,)) as pool:
        for (name, number, at), code, problems in pool.imap_unordered(_suffered, harms):
            found.append((name, code, problems))
            for problem in problems:
                print(f"{name} {number} at {at:.9f}: {problem}", flush=True)
    return found


def _begin(place: Path) -> None:
    """What a worker does first."""
    global _place
    _place = place


@cache
def _harness() -> Harness:
    """The night of this process."""
    return Harness(Path(tempfile.mkdtemp(dir=_place)))


def _suffered(harm: Harm) -> tuple[Harm, int, list[str]]:
    """Bring one harm about; returns how the run ended, and all that was wrong then and after the next run."""
    harness, (name, number, _) = _harness(), harm
    tree = harness.folder / f"{name.split()[0]}-{number}"
    if name == WRITER:
        end, problems = harness.beside_a_writer(tree)
        return harm, end.code, problems
    end = _harmed(harness, tree, harm)
    problems = [*after_harm(tree, end), *harness.after_rerun(tree)]
    shutil.rmtree(tree)
    return harm, end.code, problems


def _harmed(harness: Harness, tree: Path, harm: Harm) -> End:
    name, number, at = harm
    if name == KILL:
        return harness.killed(tree, at)
    if name == SIGNAL:
        return signalled(harness.bench, tree, at * harness.seconds, SIGNALS[number % len(SIGNALS)])
    return harness.filled(tree, round(SMALLEST_BYTES * (harness.largest / SMALLEST_BYTES) ** at))


def _table(found: list[Suffered]) -> str:
    lines = []
    for name in (KILL, DISK, SIGNAL, WRITER):
        codes, problems = Counter(), 0
        for _, code, own in (one for one in found if one[0] == name):
            codes[code] += 1
            problems += len(own)
        ends = dict(sorted(codes.items()))
        lines.append(f"{name}: {codes.total()} times, ends {ends}, {problems} problems")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
