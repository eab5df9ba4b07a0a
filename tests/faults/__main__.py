"""``PYTHONPATH=tests python -m faults --kills 100``: kill runs, fill their disks, and see what is left."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from faults.runs import End, Patches, make_night, no_file_above, rewritten, run, signalled
from faults.tree import broken, content, leftovers

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
INTERRUPTED = 130
BESIDE_A_WRITER = {0, 3, 5, 64}
PAGES = "night_"  # a run that could not even look for recordings tells so on the page of the last night


def main() -> int:
    """Return 1 if anything was left that must not be."""
    parser = argparse.ArgumentParser(prog="faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="kill -9 at so many random moments")
    parser.add_argument("--disks", type=int, default=50, help="full disks, at so many random sizes")
    parser.add_argument("--signals", type=int, default=30, help="SIGTERM, SIGHUP and SIGINT in turn")
    parser.add_argument(
        "--writers", type=int, default=10, help="runs beside a program that writes recordings"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="irlos-faults-") as place:
        harness = Harness(Path(place))
        rng = np.random.default_rng(options.seed)
        moments = rng.uniform(0, harness.seconds, options.kills)
        kills = harness.suffered("kill -9", [lambda tree, at=at: harness.killed(tree, at) for at in moments])
        sizes = np.exp(rng.uniform(np.log(100), np.log(harness.largest), options.disks)).astype(int)
        disks = harness.suffered("full disk", [lambda tree, n=n: harness.filled(tree, int(n)) for n in sizes])
        moments = rng.uniform(0, harness.seconds, options.signals)
        chosen = [(at, SIGNALS[index % len(SIGNALS)]) for index, at in enumerate(moments)]
        ends = [lambda tree, at=at, n=n: harness.signalled(tree, at, n) for at, n in chosen]
        signals = harness.suffered("signal", ends)
        writers = harness.beside_writers(options.writers)
    return int(bool(kills + disks + signals + writers))


class Harness:
    """A night, what an undisturbed run makes of it, and the comparison of disturbed ones with that."""

    def __init__(self, folder: Path, patches: object = Patches):
        self.folder = folder
        self.bench = make_night(folder / "night", patches)
        whole = folder / "undisturbed"
        start = time.perf_counter()
        self.end = run(self.bench, whole)
        self.seconds = time.perf_counter() - start
        self.content = content(whole)
        self.largest = max(path.stat().st_size for path in whole.rglob("*") if path.is_file())
        print(f"undisturbed: exit {self.end.code}, {self.seconds:.2f} s, {len(self.content)} things compared")

    def killed(self, tree: Path, after_s: float) -> End:
        """Kill a run."""
        return signalled(self.bench, tree, after_s)

    def signalled(self, tree: Path, after_s: float, number: int) -> End:
        """Ask a run to end; one that is not yet at work ends at once."""
        return signalled(self.bench, tree, after_s, number)

    def beside_writers(self, times: int) -> list[str]:
        """Run while recordings are cut and written again; return what is wrong then, and when they rest."""
        problems, ends = [], Counter()
        for number in range(times):
            tree, fresh = (self.folder / f"{name}-{number}" for name in ("written", "fresh"))
            with rewritten(self.bench):
                end = run(self.bench, tree)
            ends[end.code] += 1
            found = after_harm(tree, end) if tree.exists() else []
            found += [f"ended with {end.code}: {end.stderr}"] if end.code not in BESIDE_A_WRITER else []
            for folder in (tree, fresh):
                run(self.bench, folder)
            before, after = content(fresh), content(tree)
            names = [name for name in before | after if not name.startswith(PAGES)]
            found += [f"different: {name}" for name in names if before.get(name) != after.get(name)]
            problems += found
            for problem in found:
                print(f"writer {number}: {problem}", flush=True)
        print(f"beside a writer: {times} times, ends {dict(ends)}, {len(problems)} problems", flush=True)
        return problems

    def filled(self, tree: Path, size: int) -> End:
        """Let a run have no file larger than so many bytes."""
        return run(self.bench, tree, no_file_above(size))

    def suffered(self, name: str, harms: list[Callable[[Path], End]]) -> list[str]:
        """Return all that was wrong after harm, and after the next run."""
        problems, ends = [], Counter()
        for number, harm in enumerate(harms):
            tree = self.folder / f"{name.split()[0]}-{number}"
            end = harm(tree)
            ends[end.code] += 1
            found = [*after_harm(tree, end), *self.after_rerun(tree)]
            problems += found
            for problem in found:
                print(f"{name} {number}: {problem}", flush=True)
            shutil.rmtree(tree)
        print(f"{name}: {len(harms)} times, ends {dict(ends)}, {len(problems)} problems", flush=True)
        return problems

    def after_rerun(self, tree: Path) -> list[str]:
        """Return how the next run differs from an undisturbed one."""
        end = run(self.bench, tree)
        if end.code != self.end.code:
            return [f"the next run ended with {end.code}: {end.stderr}"]
        now = content(tree)
        names = self.content.keys() | {name for name in now if not name.startswith(PAGES)}
        different = [name for name in names if self.content.get(name) != now.get(name)]
        return [f"different afterwards: {name}" for name in different] + [
            f"left over: {path}" for path in leftovers(tree)
        ]


def after_harm(tree: Path, end: End) -> list[str]:
    """Return what nobody should come upon while the harm is not repaired."""
    problems = broken(tree) if tree.exists() else []
    if end.code == INTERRUPTED and end.stderr.count("irlos: error: interrupted") != 1:
        problems.append(f"not one line: {end.stderr}")
    if "Traceback" in end.stderr or "unexpected" in end.stderr:
        problems.append(f"stderr: {end.stderr[-500:]}")
    return problems


if __name__ == "__main__":
    sys.exit(main())
