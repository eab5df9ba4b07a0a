"""From the runs of all experiments to one report and one file of numbers, paper_results.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text
from irlos_pipe.paper.run.recipes import Experiment
from irlos_pipe.pipeline import Selection, plan_run
from irlos_pipe.product.product import Product
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.report.chapter import Chapter, read_chapter
from irlos_pipe.report.collection import write_collection
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import judged

RESULTS_NAME = "paper_results.json"
SCHEMA = {"schema": "irlos-paper", "schema_version": 2}
TIMING = "seconds"
MADE_BY = ("finished", "seconds", "jobs", "device", "software")
TITLE = "The experiments of the paper"
NOTES = {True: "Quick look: samples are small and numbers rough.", False: "Full samples."}


def require_size(folder: Path, quick: bool) -> None:
    """Refuse to replace full experiments by quick ones, or the reverse.

    Parameters
    ----------
    folder : Path
        Of all experiments.
    quick : bool
        Size of those to be run.

    Raises
    ------
    ConfigurationError
        When the folder holds experiments of the other size.
    """
    path = folder / RESULTS_NAME
    if path.is_file() and json.loads(path.read_text())["quick"] != quick:
        held = "full experiments, and --quick was" if quick else "--quick experiments, and --quick was not"
        raise ConfigurationError(f"--output {folder}: holds {held} given; choose another folder")


def collect_numbers(known: Sequence[Experiment], folder: Path, quick: bool) -> Path:
    """Write paper_results.json from all experiments that are up to date; return its path.

    Parameters
    ----------
    known : sequence of Experiment
        All, in the order of the paper.
    folder : Path
        Holds their runs.
    quick : bool
        Whether their samples are small.
    """
    current = {one.name: folder / one.name for one in known if _is_current(one, folder)}
    missing = [one.name for one in known if one.name not in current]
    path = folder / RESULTS_NAME
    write_if_changed(path, json_text(_paper_results(current, quick, missing)).encode())
    return path


def collect_reports(
    known: Sequence[Experiment], folder: Path, quick: bool, problems: Mapping[str, str]
) -> Path:
    """Write the report on all experiments that are up to date or failed; return its path.

    The parameters are those of `collect_numbers`, and `problems`, what stopped an experiment, by name:
    `known`, `folder`, `quick`.
    """
    shown = [one for one in known if one.name in problems or _is_current(one, folder)]
    chapters = [_chapter(one, folder / one.name, problems.get(one.name, "")) for one in shown]
    return write_collection(RunFolder(folder).report, TITLE, NOTES[quick], chapters)


def _is_current(experiment: Experiment, folder: Path) -> bool:
    """Whether the products on disk are those of the recipe as it is now."""
    try:
        _, steps = plan_run(experiment.recipe, folder / experiment.name, Selection())
    except IrlosError:
        return False
    return all(step.current for step in steps)


def _chapter(experiment: Experiment, folder: Path, problem: str) -> Chapter:
    try:
        return read_chapter(experiment.name, folder, problem)
    except Exception as error:  # the others can be shown without it
        reason = problem or f"cannot be shown: {type(error).__name__}: {error}"
        return Chapter(experiment.name, experiment.title, problems=[reason])


# -- numbers ---------------------------------------------------------------------------------------


def _paper_results(folders: Mapping[str, Path], quick: bool, missing: Sequence[str]) -> dict[str, Any]:
    """Return the content of paper_results.json.

    What changes from run to run (times, machine, software) stands under ``runs``; all the rest is
    the same for the same recipes and software.
    """
    experiments, runs = {}, {}
    for name, folder in folders.items():
        products = {
            stage: read_product(path, arrays=False) for stage, path in existing_run(folder).products().items()
        }
        experiments[name] = _experiment(products)
        runs[name] = {stage: _made(product) for stage, product in products.items()}
    return {**SCHEMA, "quick": quick, "missing": list(missing), "experiments": experiments, "runs": runs}


def _experiment(products: Mapping[str, Product]) -> dict[str, Any]:
    last = list(products.values())[-1]
    return {
        "recipe": last.provenance["recipe"],
        "seed": last.provenance["seed"],
        "sizes": {stage: product.config for stage, product in products.items()},
        "results": {stage: _without_timings(product.results) for stage, product in products.items()},
        "checks": {
            stage: [check.as_dict() for check in judged(STAGES[stage], product)]
            for stage, product in products.items()
        },
    }


def _without_timings(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_timings(inner) for key, inner in value.items() if not _is_timing(key)}
    return [_without_timings(inner) for inner in value] if isinstance(value, list) else value


def _timings(value: Any, above: str = "") -> dict[str, float]:
    """Timings among the results, by their dotted path."""
    found: dict[str, float] = {}
    for key, inner in _members(value):
        path = f"{above}.{key}" if above else str(key)
        found |= {path: inner} if _is_timing(key) else _timings(inner, path)
    return found


def _members(value: Any) -> Iterable[tuple[Any, Any]]:
    if isinstance(value, Mapping):
        return value.items()
    return enumerate(value) if isinstance(value, list) else ()


def _is_timing(key: Any) -> bool:
    return isinstance(key, str) and TIMING in key.split("_")


def _made(product: Product) -> dict[str, Any]:
    """How a product was made; the name of the host is left out."""
    made = {key: product.provenance.get(key) for key in MADE_BY}
    platform = product.provenance.get("machine", {}).get("platform")
    return made | {"platform": platform, "timings": _timings(product.results)}
