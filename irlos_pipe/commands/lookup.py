"""Commands that look things up: recipes."""

from __future__ import annotations

import click


@click.command()
@click.argument("name", required=False)
def recipes(name: str | None) -> None:
    """List the recipes and specifications that come with the package, or print the one called NAME.

    \b
    Examples:
      irlos recipes
      irlos recipes ncpa_calibration > mine.yaml
      irlos recipes on_sky > night.yaml
    """
    from irlos_pipe.recipe.listing import recipe_list, recipe_text

    click.echo(recipe_list() if name is None else recipe_text(name), nl=name is None)
