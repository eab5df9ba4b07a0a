"""Recipes without inputs, whose stages make their own data: every command takes them."""

import json
import sys

import numpy as np
import pytest
from conftest import invoke
from helpers.fake_stages import FreeResults

from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageOutput

RECIPE = "recipe: made_here\ntitle: a stage that draws numbers\n{inputs}\nstages: [lift]\n"


def lift(ctx) -> StageOutput:
    draws = np.random.default_rng(ctx.seed).normal(size=5)
    results = FreeResults(mean_nm=draws.mean())
    return StageOutput({"draws": Quantity(draws, "nm")}, results, summary=["five draws"])


@pytest.mark.parametrize("inputs", ["inputs: {}", "inputs:", ""])
def test_a_recipe_without_inputs_is_valid_planned_run_shown_and_made_again(bench, monkeypatch, inputs):
    stage = sys.modules["irlos_pipe.stages.lift.stage"]
    monkeypatch.setattr(stage, "run", lift)
    monkeypatch.setattr(stage, "NEEDS", ())
    bench.recipe.write_text(RECIPE.format(inputs=inputs))
    assert invoke("validate", str(bench.recipe)).exit_code == 0
    assert bench.run("--dry-run").output.split() == ["lift", "run", "no", "product", "yet"]
    assert bench.run().exit_code == 0
    assert bench.run("--dry-run").output.split() == ["lift", "skip", "up", "to", "date"]
    assert "seed changed 0 -> 4" in bench.run("--dry-run", "--seed", "4").output
    assert "up to date" in invoke("status", str(bench.output)).output
    assert "draws" in invoke("show", str(bench.output / "01_lift.h5")).output
    result = bench.run("--input", f"cube={bench.data}")
    assert result.exit_code == 2 and "unknown input 'cube'; the recipe has no inputs" in result.output
    first = json.loads((bench.output / "results.json").read_text())
    bench.recipe.write_text((bench.output / "recipe.resolved.yaml").read_text())
    assert bench.run("--force").exit_code == 0
    assert json.loads((bench.output / "results.json").read_text()) == first
