"""A night, what an undisturbed run makes of it, and what is left of runs that come to harm."""

import time
from pathlib import Path

from faults.runs import End, Patches, end_at, make_night, no_file_above, rewritten, run
from faults.tree import broken, content, leftovers
from irlos_pipe.pipeline.run import software_versions

INTERRUPTED = 130
BESIDE_A_WRITER = {0, 3, 5, 64}
PAGES = "night_"  # a run that could not even look for recordings tells so on the page of the last night


class Harness:
    """A night, what an undisturbed run makes of it, and the comparison of disturbed ones with that."""

    def __init__(self, folder: Path, patches: object = Patches):
        self.folder = folder
        self.bench = make_night(folder / "night", patches)
        software_versions()  # once for all runs: a checkout that is edited meanwhile has another revision
        whole = folder / "undisturbed"
        start = time.perf_counter()
        self.end = run(self.bench, whole)
        self.seconds = time.perf_counter() - start
        self.content = content(whole)
        self.largest = max(path.stat().st_size for path in whole.rglob("*") if path.is_file())
        print(f"undisturbed: exit {self.end.code}, {self.seconds:.2f} s, {len(self.content)} things compared")

    def killed(self, tree: Path, part: float) -> End:
        """Kill a run after a part of the work (0 to 1) of the undisturbed one."""
        return run(self.bench, tree, end_at(part * self.end.cpu_s))

    def beside_a_writer(self, tree: Path) -> tuple[End, list[str]]:
        """Run while a recording is cut and written again; return what is wrong then, and when it rests."""
        fresh = tree.with_name(f"{tree.name}-fresh")
        with rewritten(self.bench):
            end = run(self.bench, tree)
        problems = after_harm(tree, end) if tree.exists() else []
        problems += [f"ended with {end.code}: {end.stderr}"] if end.code not in BESIDE_A_WRITER else []
        for folder in (tree, fresh):
            run(self.bench, folder)
        before, after = content(fresh), content(tree)
        names = [name for name in before | after if not name.startswith(PAGES)]
        problems += [f"different: {name}" for name in names if before.get(name) != after.get(name)]
        return end, problems

    def filled(self, tree: Path, size: int) -> End:
        """Let a run have no file larger than so many bytes."""
        return run(self.bench, tree, no_file_above(size))

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
