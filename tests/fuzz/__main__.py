"""``PYTHONPATH=tests python -m fuzz --cases 1000 --seed 0``: judge that many cases and sum up."""

import argparse
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterator

from fuzz import pristine
from fuzz.case import KINDS
from fuzz.judge import TIME_S, Verdict, judged

NO_ANSWER_S = 30 * TIME_S  # a process that was killed, or hangs where no signal reaches it


def main() -> int:
    """Judge cases, all kinds in turn; returns 1 if any input brought about what it must not."""
    options = _options()
    kinds = options.kind or sorted(KINDS)
    numbers = range(options.seed, options.seed + -(-options.cases // len(kinds)))
    cases = [(kind, number) for number in numbers for kind in kinds][: options.cases]
    for name in ("recorder", "cube", "muse"):
        pristine.reference(name)
    pristine.run_files()
    start = time.perf_counter()
    verdicts = list(_all_judged(cases, options.jobs))
    print(_table(verdicts, kinds))
    findings = [verdict for verdict in verdicts if verdict.finding]
    print(
        f"{len(verdicts)} cases from seed {options.seed} in {time.perf_counter() - start:.0f} s, "
        f"{sum(verdict.compared for verdict in verdicts)} results compared, {len(findings)} findings"
    )
    return int(bool(findings))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="first of the seeds, which count up")
    parser.add_argument(
        "--kind", action="append", choices=sorted(KINDS), help="only this kind; may be repeated"
    )
    parser.add_argument("--jobs", type=int, default=1)
    return parser.parse_args()


def _all_judged(cases: list[tuple[str, int]], jobs: int) -> Iterator[Verdict]:
    """Yield a verdict per case, printing findings at once."""
    with multiprocessing.get_context("fork").Pool(jobs, maxtasksperchild=100) as pool:
        waiting = [(kind, seed, pool.apply_async(judged, (kind, seed))) for kind, seed in cases]
        for kind, seed, answer in waiting:
            try:
                verdict = answer.get(NO_ANSWER_S)
            except multiprocessing.TimeoutError:
                verdict = Verdict(kind, seed, "", -1, "no answer: the process died or hangs")
            if verdict.finding:
                print(f"{kind} {seed} ({verdict.summary}): {verdict.finding}", flush=True)
            yield verdict


def _table(verdicts: list[Verdict], kinds: list[str]) -> str:
    codes = sorted({verdict.exit_code for verdict in verdicts})
    lines = [
        f"{'kind':<20}{'cases':>7}" + "".join(f"{f'exit {code}':>9}" for code in codes) + f"{'findings':>10}"
    ]
    for kind in kinds:
        own = [verdict for verdict in verdicts if verdict.kind == kind]
        count = Counter(verdict.exit_code for verdict in own)
        lines.append(
            f"{kind:<20}{len(own):>7}"
            + "".join(f"{count[code] or '':>9}" for code in codes)
            + f"{sum(bool(verdict.finding) for verdict in own) or '':>10}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
