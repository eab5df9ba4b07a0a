"""Products and run folders as text."""

from __future__ import annotations

from pathlib import Path

import yaml

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.conventions.text import aligned, printable
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.standing import is_standing
from irlos_pipe.product.storage import read_product

UP_TO_DATE = "up to date"


def product_text(path: Path) -> str:
    """Return what the product at `path` contains: provenance, arrays, results, configuration, QC and log."""
    product = read_product(path)
    arrays = [_array_row(name, quantity) for name, quantity in product.arrays.items()]
    parts = {
        "": _origin(path, product),
        "arrays": aligned(arrays) if arrays else "none",
        "results": _yaml(product.results),
        "configuration": _yaml(product.config),
        "checks": "\n".join(map(_check_line, product.checks)) or "none",
        "log": "\n".join(product.log) or "empty",
    }
    text = "\n\n".join(_titled(title, text) for title, text in parts.items())
    return "\n".join(map(printable, text.split("\n")))


def status_text(folder: Path) -> str:
    """Return one line per stage of a run: whether it is up to date, its QC and when it was made.

    Raises
    ------
    InputDataError
        When `folder` holds no run.
    """
    run = existing_run(folder)
    states = _states(run)
    rows = [("product", "state", "QC", "finished")]
    for path in sorted(run.path.glob("[0-9][0-9]_*.h5")):
        rows.append((path.name, states.pop(path.name, "not of this recipe"), *_quality_and_time(path)))
    rows += [(name, state, "-", "-") for name, state in states.items()]
    return aligned(rows)


def _states(run: RunFolder) -> dict[str, str]:
    """State of each product of the run's recipe by file name."""
    if is_standing(run):
        return {path.name: UP_TO_DATE for path in _paths(run)}
    # late: a plan needs the modules of all stages, which take seconds to load
    from irlos_pipe.pipeline.plan import Selection
    from irlos_pipe.pipeline.run import plan_run
    from irlos_pipe.recipe import load_recipe

    try:
        _, steps = plan_run(load_recipe(run.recipe), run.path, Selection())
    except IrlosError as error:
        reason = str(error).splitlines()[0]
        return {path.name: f"cannot be checked: {reason}" for path in run.path.glob("[0-9][0-9]_*.h5")}
    return {step.path.name: step.reason if step.current else f"outdated: {step.reason}" for step in steps}


def _paths(run: RunFolder) -> list[Path]:
    """The products of the run's recipe."""
    stages = load_yaml(run.recipe)[0]["stages"]
    return [run.product(position, stage) for position, stage in enumerate(stages, 1)]


def _quality_and_time(path: Path) -> tuple[str, str]:
    try:
        product = read_product(path, arrays=False)
    except InputDataError:
        return "-", "-"
    passed = sum(check.passed for check in product.checks)
    return f"{passed}/{len(product.checks)}", provenance_of(product).finished or "-"


def _origin(path: Path, product: Product) -> str:
    made = provenance_of(product)
    software = ", ".join(f"{name} {version}" for name, version in made.software.items())
    rows = [
        ("product", f"{path.name}, stage '{product.stage}'"),
        ("made", made.finished),
        ("took", f"{made.seconds} s on {made.machine.host}"),
        ("command", made.command),
        ("software", software),
        ("inputs", f"{len(made.inputs)} files"),
        ("seed", str(made.seed)),
    ]
    return aligned(rows)


def _array_row(name: str, quantity: Quantity) -> tuple[str, ...]:
    shape = "x".join(map(str, quantity.value.shape)) or "scalar"
    error = "with error" if quantity.error is not None else ""
    return name, shape, str(quantity.value.dtype), quantity.unit or "-", error, quantity.description


def _check_line(check: Check) -> str:
    low = "-inf" if check.low is None else f"{check.low:g}"
    high = "inf" if check.high is None else f"{check.high:g}"
    verdict = "passed" if check.passed else "FAILED"
    return f"{verdict}  {check.name} = {check.value:g} {check.unit} [{low} ... {high}]  {check.message}"


def _yaml(content: dict) -> str:
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None).rstrip()


def _titled(title: str, text: str) -> str:
    return f"{title}:\n" + "\n".join(f"  {line}" for line in text.splitlines()) if title else text
