"""Runs into numbered versions of one folder: what is there stays, what differs gets a new number."""

from __future__ import annotations

from pathlib import Path

from irlos_pipe.pipeline.outcome import Outcome
from irlos_pipe.pipeline.plan import NO_PRODUCT, Action, Selection
from irlos_pipe.pipeline.resources import Resources
from irlos_pipe.pipeline.run import plan_run, run_recipe
from irlos_pipe.product.runfolder import RunFolder, owned_folder
from irlos_pipe.product.versions import (
    is_complete,
    link_latest,
    new_version,
    require_free_for_versions,
    version_folders,
)
from irlos_pipe.recipe import Recipe


def version_for(recipe: Recipe, folder: Path, selection: Selection) -> Path:
    """Return the folder that a run would use: the newest version if the run would change nothing in it.

    A run that only adds what the newest version has not got, after an interruption for example, continues it.

    Parameters
    ----------
    recipe : Recipe
        What to run.
    folder : Path
        Folder of the versions; it need not exist.
    selection : Selection
        Which stages may run.

    Raises
    ------
    ConfigurationError
        When the folder cannot hold versions, or the selection cannot be used.
    InputDataError, NothingToDo
        When input files cannot be read, or there are none.
    """
    require_free_for_versions(folder)
    there = version_folders(folder)
    if there and not selection.force and _only_adds(recipe, there[-1], selection):
        return there[-1]
    return new_version(folder)


def run_numbered(
    recipe: Recipe, folder: Path, selection: Selection | None = None, resources: Resources | None = None
) -> Outcome:
    """Bring the products of a recipe up to date without changing a version that is there.

    Parameters
    ----------
    recipe : Recipe
        What to run.
    folder : Path
        Folder of the versions; made if it does not exist.
    selection, resources : optional
        See `pipeline.run.run_recipe`.

    Returns
    -------
    Outcome
        That of the run into the version; ``latest`` leads to it if it is complete.

    Raises
    ------
    Locked
        When another run works on these versions.
    IrlosError
        When a stage cannot do its work; ``latest`` leads to where it led before.
    """
    selection = selection or Selection()
    plan_run(recipe, version_for(recipe, folder, selection), selection)  # a mistake leaves no folder behind
    with owned_folder(folder):
        version = version_for(recipe, folder, selection)
        outcome = run_recipe(recipe, version, selection, resources)
        if is_complete(RunFolder(version)):
            link_latest(folder, version)
        return outcome


def _only_adds(recipe: Recipe, version: Path, selection: Selection) -> bool:
    """Whether a run into a version would make only products that are not there."""
    run = RunFolder(version)
    if not run.recipe.is_file():
        return True
    _, steps = plan_run(recipe, version, selection)
    others = set(run.product_files) - {step.path for step in steps}
    return not others and all(step.action is not Action.RUN or step.reason == NO_PRODUCT for step in steps)
