"""What all suites share: cases go to processes, what comes of them to files, tables to the documentation.

A suite is a list of cases, a function that makes one and judges it, and a table. What came of a case is kept
in a file of its own as soon as it is there: a run is gone on with where it stopped.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Protocol

import click
import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.files.processes import in_processes
from irlos_pipe.pipeline.resources import silent_progress
from irlos_pipe.product.product import Check, Product
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import StageContext

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
KEPT_DIGITS = 6
CONFIDENCE = 0.95

Outcome = Mapping[str, Any]


class Case(Protocol):
    """One draw: the name of its file, and what its outcome must say of it (seeds, number of frames)."""

    @property
    def name(self) -> str: ...

    @property
    def key(self) -> tuple: ...


@dataclass(frozen=True)
class Suite:
    """What is done with the cases; worker processes import its functions by name."""

    # What comes of a case, in JSON types, by the case and the folder of the suite.
    outcome: Callable[[Any, Path], Outcome]
    key: Callable[[Outcome], tuple]  # what an outcome says of its case
    # Tables as text, by the outcomes, what stopped the other cases, by name, and the folder.
    report: Callable[[Sequence[Outcome], Mapping[str, str], Path], str]
    # page, mark: page of the documentation, and the mark there; none where tables are not put into one.
    page: str = ""
    mark: str = ""
    full: Callable[[Sequence[Outcome]], str] | None = None  # what the page sums up, for docs/MARK.csv
    inside: str = ""  # folder of the outcomes within that of the suite
    slim: Callable[[Outcome], Outcome] = dict  # what of an outcome is kept with the project
    present: Callable[[Outcome], Outcome] = dict  # an outcome of an earlier version as it is written now

    def path(self, case: Case, output: Path) -> Path:
        """Return the file of an outcome; there when the case is finished."""
        return output / self.inside / f"{case.name}.json"

    def work(self, case: Case, output: Path) -> Outcome:
        """Return the outcome of a case, computed unless it is there."""
        path = self.path(case, output)
        if not path.is_file():
            outcome = self.outcome(case, output)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, json_text(outcome).encode())
        outcome = self.present(json.loads(path.read_text()))
        if self.key(outcome) != case.key:
            raise ValueError(f"{path} has another seed or number of frames; give another folder")
        return outcome


def options(seed: int) -> Callable[[Callable], Callable]:
    """Return the options of every suite, for `run`; `seed` is that of the reported run."""
    common = (
        click.option("--output", type=click.Path(path_type=Path, file_okay=False), help="For everything."),
        click.option(
            "--seed",
            type=click.IntRange(0, 2**32 - 1),
            default=seed,
            show_default=True,
            help="Of all draws. Whoever changes what is measured takes another one than the reported.",
        ),
        click.option("--jobs", default=1, show_default=True, help="Worker processes, of one thread each."),
        click.option("--only", default="*", help="Cases whose name matches, for example '*companion*'."),
        click.option("--sample", type=int, help="That many of them, evenly spread."),
        click.option("--finished", is_flag=True, help="Those that are finished already; run none."),
        click.option(
            "--kept",
            type=click.Path(path_type=Path, dir_okay=False),
            help="File whose outcomes count as finished; those of this run are added.",
        ),
        click.option("--list", "listed", is_flag=True, help="Print the names of the cases and stop."),
        click.option("--docs", is_flag=True, help="Put the tables into their page of the documentation."),
    )

    def decorated(command: Callable) -> Callable:
        for option in reversed(common):
            command = option(command)
        return command

    return decorated


def run(
    suite: Suite,
    cases: Sequence[Case],
    *,
    output: Path | None,
    jobs: int = 1,
    only: str = "*",
    sample: int | None = None,
    finished: bool = False,
    kept: Path | None = None,
    listed: bool = False,
    docs: bool = False,
) -> None:
    """Run the chosen cases that the folder `output` lacks, and print what came of all; see `options`."""
    cases = chosen(cases, only, sample)
    if listed:
        click.echo("\n".join(case.name for case in cases))
        return
    if docs and not suite.page:
        raise click.UsageError("--docs: these tables have no place in the documentation")
    if output is None:
        raise click.UsageError("give --output DIR, a folder for everything")
    output = output.resolve()
    if kept is not None:
        lay_out(suite, kept, cases, output)
    if finished:
        cases = [case for case in cases if suite.path(case, output).is_file()]
    if not cases:
        raise click.UsageError(f"nothing to do: no case is chosen, or {output} has none that is finished")
    output.mkdir(parents=True, exist_ok=True)
    outcomes, broken = worked(suite, cases, output, jobs)
    if kept is not None:
        keep(suite, kept, outcomes)
    text = suite.report(outcomes, broken, output)
    click.echo("\n".join([text, *(f"stopped by an error: {name}: {why}" for name, why in broken.items())]))
    if docs:
        put(DOCS / suite.page, {suite.mark: text})
        if suite.full is not None:
            write_bytes(DOCS / f"{suite.mark}.csv", suite.full(outcomes).encode())
    raise SystemExit(1 if broken else 0)


def chosen(cases: Sequence[Case], only: str = "*", sample: int | None = None) -> list[Any]:
    """Return the cases whose name matches a pattern, or some of them, evenly spread."""
    matching = [case for case in cases if fnmatch(case.name, only)]
    if sample is None or sample >= len(matching):
        return matching
    return [matching[index] for index in np.linspace(0, len(matching) - 1, sample).astype(int)]


def worked(
    suite: Suite, cases: Sequence[Case], output: Path, jobs: int
) -> tuple[list[Outcome], dict[str, str]]:
    """Return the outcomes in the order of the `cases`, and what stopped those that have none, by name."""
    outcomes, broken = [], {}
    tasks = [(case, output) for case in cases]
    with in_processes(max(1, min(jobs, len(cases))), suite.work, tasks) as futures:
        for _ in tqdm(as_completed(futures), total=len(cases), desc="cases"):
            pass
    for case, future in zip(cases, futures, strict=True):
        try:
            outcomes.append(future.result())
        except Exception as problem:  # one case that breaks must not end hours of others
            broken[case.name] = f"{type(problem).__name__}: {problem}"
    return outcomes, broken


def reduced(
    recipe: Recipe, scratch: Path, log: logging.Logger, leave_out: Sequence[str] = ("correct",)
) -> tuple[dict[str, Product], list[Check]]:
    """Run the stages of a recipe one after the other, without files and report.

    Returns their products, and the checks that failed.
    """
    products: dict[str, Product] = {}
    for name in (one for one in recipe.stages if one not in leave_out):
        config, of = recipe.configs[name], (recipe.model, recipe.instrument, recipe.inputs, products)
        how = "cpu", recipe.seed, 1, silent_progress, log, scratch / name
        output = STAGES[name].run(StageContext(config, *of, *how))
        content = output.arrays, output.results.as_json(), list(output.checks), config.model_dump(mode="json")
        products[name] = Product(name, *content)
    return products, [one for product in products.values() for one in product.checks if not one.passed]


# -- outcomes that are kept with the project ---------------------------------------------------


def read_lines(file: Path) -> list[Outcome]:
    """Return the outcomes that a `file` keeps, one in each line; none of a file that is not there."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def lay_out(suite: Suite, file: Path, cases: Iterable[Case], output: Path) -> None:
    """Put the outcomes of `cases` that a `file` keeps into a folder that lacks them."""
    kept = {suite.key(one): one for one in read_lines(file)}
    for case in cases:
        path = suite.path(case, output)
        if case.key in kept and not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, json_text(kept[case.key]).encode())


def keep(suite: Suite, file: Path, outcomes: Iterable[Outcome]) -> None:
    """Write `outcomes` into a `file` jointly with those that it has, numbers rounded to six digits."""
    every = {suite.key(one): suite.slim(one) for one in (*read_lines(file), *outcomes)}
    lines = (
        json.dumps(_rounded(every[key]), allow_nan=False, ensure_ascii=False) + "\n" for key in sorted(every)
    )
    write_bytes(file, "".join(lines).encode())


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{KEPT_DIGITS}g}") if isinstance(value, float) else value


# -- tables ------------------------------------------------------------------------------------


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]], sides: str = "") -> str:
    """Return a table in Markdown; `sides` has an "l" or "r" for every column, all "l" if it is empty."""
    rule = "".join("---:|" if side == "r" else "---|" for side in sides or "l" * len(head))
    lines = (f"| {' | '.join(map(str, cells))} |" for cells in (head, *rows))
    return "\n".join([next(lines), f"|{rule}", *lines])


def put(page: Path, parts: Mapping[str, str]) -> None:
    """Write every text between ``<!-- NAME -->`` and ``<!-- /NAME -->`` of a page; exit without them."""
    text = page.read_text(encoding="utf-8")
    for name, content in parts.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
        marked, block = rf"{re.escape(begin)}.*?{re.escape(end)}", f"{begin}\n{content}\n\n{end}"
        text, found = re.subn(marked, lambda _, block=block: block, text, flags=re.DOTALL)
        if not found:
            raise SystemExit(f"{page.name}: no place for the {name}: the marks {begin.strip()} are missing")
    page.write_text(text, encoding="utf-8")


def file_name(words: str) -> str:
    """Return `words` as a part of a file name."""
    return "".join(letter if letter.isalnum() else "_" for letter in words)


@dataclass(frozen=True)
class Rate:
    """How often something happened, with the Clopper–Pearson interval of 95 % for the probability."""

    count: int
    total: int
    low: float
    high: float

    @classmethod
    def of(cls, happened: Iterable[bool]) -> Rate:
        """Of a series of events; without any the interval is everything."""
        events = [bool(one) for one in happened]
        if not events:
            return cls(0, 0, 0.0, 1.0)
        interval = binomtest(sum(events), len(events)).proportion_ci(CONFIDENCE, method="exact")
        return cls(sum(events), len(events), float(interval.low), float(interval.high))

    @property
    def value(self) -> float:
        """The rate; NaN without events."""
        return self.count / self.total if self.total else float("nan")

    @property
    def text(self) -> str:
        """For tables."""
        if not self.total:
            return "-"
        return f"{self.count}/{self.total} = {self.value:.1%} ({self.low:.1%} to {self.high:.1%})"

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return asdict(self) | {"value": self.value}
