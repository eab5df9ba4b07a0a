"""paper_results.json: the numbers of every experiment, with seeds and sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from irlos_pipe.product.product import Product, read_product
from irlos_pipe.product.runfolder import existing_run

SCHEMA = {"schema": "irlos-paper", "schema_version": 1}
TIMING = "seconds"
MADE_BY = ("finished", "seconds", "jobs", "device", "software")


def paper_results(folders: Mapping[str, Path], quick: bool, missing: Sequence[str]) -> dict[str, Any]:
    """Put together what the runs of the experiments found.

    What changes from run to run (times, machine, software) stands under ``runs``; all the rest is
    the same for the same recipes and software.

    Parameters
    ----------
    folders : mapping of str to Path
        Folders of finished runs by the experiment's name, in the order of the paper.
    quick : bool
        Whether their samples are small.
    missing : sequence of str
        Names of the experiments that are not among them.

    Raises
    ------
    InputDataError
        When a product cannot be read.
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
        "checks_failed": [
            f"{stage}: {check.name}"
            for stage, product in products.items()
            for check in product.checks
            if not check.passed
        ],
    }


def _without_timings(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_timings(inner) for key, inner in value.items() if not _is_timing(key)}
    return [_without_timings(inner) for inner in value] if isinstance(value, list) else value


def _timings(value: Any, above: str = "") -> dict[str, float]:
    """Timings among the results, by their dotted place."""
    found: dict[str, float] = {}
    for key, inner in _members(value):
        place = f"{above}.{key}" if above else str(key)
        found |= {place: inner} if _is_timing(key) else _timings(inner, place)
    return found


def _members(value: Any) -> Iterable[tuple[Any, Any]]:
    if isinstance(value, Mapping):
        return value.items()
    return enumerate(value) if isinstance(value, list) else ()


def _is_timing(key: Any) -> bool:
    return isinstance(key, str) and TIMING in key.split("_")


def _made(product: Product) -> dict[str, Any]:
    """How a product was made; the host's name is nobody's business."""
    made = {key: product.provenance.get(key) for key in MADE_BY}
    platform = product.provenance.get("machine", {}).get("platform")
    return made | {"platform": platform, "timings": _timings(product.results)}
