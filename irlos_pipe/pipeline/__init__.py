"""Runs: plan a recipe, skip what is up to date and say why, run the rest, sum up."""

from irlos_pipe.pipeline.plan import Selection, Step, plan_run
from irlos_pipe.pipeline.resources import Resources
from irlos_pipe.pipeline.run import Outcome, run_recipe

__all__ = ["Outcome", "Resources", "Selection", "Step", "plan_run", "run_recipe"]
