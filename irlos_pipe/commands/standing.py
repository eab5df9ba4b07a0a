"""Which products of a run are up to date, and why the others are not."""

from __future__ import annotations

from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.printed import ProductRow, RunStatus
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.standing import is_standing
from irlos_pipe.product.storage import read_product

CURRENT, OUTDATED = "up to date", "outdated"
FOREIGN, UNKNOWN = "not of this recipe", "cannot be checked"
State = tuple[str, str]  # and why


def run_status(folder: Path) -> RunStatus:
    """Return where each product of the run in `folder` stands.

    Raises
    ------
    InputDataError
        When `folder` holds no run.
    """
    run = existing_run(folder)
    states = _states(run)
    current = all(state == CURRENT for state, _ in states.values())
    there = [path.name for path in run.product_files]
    rows = [_row(run.path / name, *states.pop(name, (FOREIGN, ""))) for name in there]
    rows += [ProductRow(product=name, state=state, reason=why) for name, (state, why) in states.items()]
    return RunStatus(run=str(folder), current=current, products=rows)


def _states(run: RunFolder) -> dict[str, State]:
    """State of each product of the run's recipe by file name."""
    if is_standing(run):
        stages = load_yaml(run.recipe)[0]["stages"]
        return {run.product(position, stage).name: (CURRENT, "") for position, stage in enumerate(stages, 1)}
    # late: a plan needs the modules of all stages
    from irlos_pipe.pipeline.plan import Selection
    from irlos_pipe.pipeline.run import plan_run
    from irlos_pipe.recipe import load_recipe

    try:
        _, steps = plan_run(load_recipe(run.recipe), run.path, Selection())
    except IrlosError as error:
        reason = str(error).splitlines()[0]
        return {path.name: (UNKNOWN, reason) for path in run.product_files}
    return {step.path.name: (CURRENT, "") if step.current else (OUTDATED, step.reason) for step in steps}


def _row(path: Path, state: str, reason: str) -> ProductRow:
    told = {"product": path.name, "state": state, "reason": reason}
    try:
        product = read_product(path, arrays=False)
    except InputDataError:
        return ProductRow(**told)
    return ProductRow(
        **told,
        checks=len(product.checks),
        passed=sum(check.passed for check in product.checks),
        finished=provenance_of(product).finished,
    )
