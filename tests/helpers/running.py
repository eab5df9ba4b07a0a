"""Shorthands for tests that run a recipe of stand-in stages."""

import json

from conftest import Bench

from helpers.fake_stages import COUNTS
from irlos_pipe.pipeline import Selection, plan_run, run_recipe
from irlos_pipe.recipe import load_recipe

STAGES = ("ingest", "calibrate", "lift")


def run(bench: Bench, *settings: str, selection: Selection | None = None, **changes):
    """Run the recipe of the bench; returns its outcome and which stages worked."""
    before = COUNTS.copy()
    outcome = run_recipe(load_recipe(bench.recipe, settings, **changes), bench.output, selection)
    return outcome, [name for name in STAGES if COUNTS[name] > before[name]]


def reasons(bench: Bench, *settings: str, selection: Selection | None = None, **changes) -> dict[str, str]:
    recipe = load_recipe(bench.recipe, settings, **changes)
    return {step.name: step.reason for step in plan_run(recipe, bench.output, selection or Selection())[1]}


def results(bench: Bench) -> dict:
    return json.loads((bench.output / "results.json").read_text())


def visible(bench: Bench) -> list[str]:
    return sorted(path.name for path in bench.output.iterdir() if not path.name.startswith("."))
