"""What is wrong with the recordings of a recipe, told before anything runs."""

from __future__ import annotations

from collections.abc import Collection

from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES


def input_problems(recipe: Recipe, stages: Collection[str] | None = None) -> list[str]:
    """Return a line for everything that is wrong with the recordings of a recipe and their side-cars.

    Parameters
    ----------
    recipe : Recipe
        Its inputs are looked at.
    stages : collection of str, optional
        Stages that would read them; by default all.

    Raises
    ------
    NothingToDo
        When there are no recordings under an input.
    """
    lines = []
    for name in recipe.stages if stages is None else stages:
        find = getattr(STAGES[name], "problems", None)
        if find is not None:
            given = {key: paths for key, paths in recipe.inputs.items() if paths}
            lines += find(given, recipe.configs[name], recipe.instrument)
    return lines
