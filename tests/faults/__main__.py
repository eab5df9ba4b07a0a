"""``PYTHONPATH=tests python -m faults --kills 100``: kill runs, fill their disks, and see what is left."""

import argparse
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from faults.harness import Harness, after_harm
from faults.runs import signalled

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
KILL, DISK, SIGNAL, WRITER = "kill -9", "full disk", "signal", "beside a writer"
SMALLEST_BYTES = 100


def main() -> int:
    """Return 1 if anything was left that must not be; problems are printed at once."""
    options, found = _options(), []
    with tempfile.TemporaryDirectory(prefix="irlos-faults-") as place:
        harness = Harness(Path(place))
        for name, number, at in _harms(options):
            code, problems = _suffered(harness, name, number, at)
            found.append((name, code, problems))
            for problem in problems:
                print(f"{name} {number} at {at:.9f}: {problem}", flush=True)
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
    return parser.parse_args()


def _harms(options: argparse.Namespace) -> Iterator[tuple[str, int, float]]:
    """Name, number, where within its range, 0 to 1; after a writer the recordings have other times."""
    counts = {KILL: options.kills, DISK: options.disks, SIGNAL: options.signals, WRITER: options.writers}
    for place, (name, count) in enumerate(counts.items()):
        drawn = np.random.default_rng([options.seed, place]).uniform(size=count)
        yield from ((name, number, float(at)) for number, at in enumerate(drawn))


def _suffered(harness: Harness, name: str, number: int, at: float) -> tuple[int, list[str]]:
    """Bring one harm about; returns how the run ended, and all that was wrong then and after the next run."""
    tree = harness.folder / f"{name.split()[0]}-{number}"
    if name == WRITER:
        end, problems = harness.beside_a_writer(tree)
        return end.code, problems
    if name == KILL:
        end = harness.killed(tree, at)
    elif name == SIGNAL:
        end = signalled(harness.bench, tree, at * harness.seconds, SIGNALS[number % len(SIGNALS)])
    else:
        end = harness.filled(tree, round(SMALLEST_BYTES * (harness.largest / SMALLEST_BYTES) ** at))
    problems = [*after_harm(tree, end), *harness.after_rerun(tree)]
    shutil.rmtree(tree)
    return end.code, problems


def _table(found: list[tuple[str, int, list[str]]]) -> str:
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
