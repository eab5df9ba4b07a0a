"""Recipes: which stages run on which inputs with which settings, checked before anything runs."""

from irlos_pipe.recipe.load import Recipe, load_recipe

__all__ = ["Recipe", "load_recipe"]
