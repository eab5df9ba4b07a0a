"""Recipes without inputs, whose stages make their own data: every command takes them."""

import json
import sys

import numpy as np
import pytest
from conftest import invoke
from helpers.fake_stages import FreeResults

from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageOutput

RECIPE = """\
recipe: made_here
title: a stage that draws numbers
{inputs}
stages: [lift]
"""


def lift(ctx) -> StageOutput:
    draws = np.random.default_rng(ctx.seed).normal(size=5)
    results = FreeResults(mean_nm=draws.mean())
    return StageOutput({"draws": Quantity(draws, "nm")}, results, summary=["five draws"])


@pytest.fixture(params=["inputs: {}", "inputs:", ""])
def alone(bench, monkeypatch, request):
    """A bench whose recipe has one stage and no input."""
    stage = sys.modules["irlos_pipe.stages.lift.stage"]
    monkeypatch.setattr(stage, "run", lift)
    monkeypatch.setattr(stage, "NEEDS", ())
    bench.recipe.write_text(RECIPE.format(inputs=request.param))
    return bench


def test_it_is_valid_planned_run_and_up_to_date_afterwards(alone):
    assert invoke("validate", str(alone.recipe)).exit_code == 0
    assert alone.run("--dry-run").output.split() == ["lift", "run", "no", "product", "yet"]
    assert alone.run().exit_code == 0
    again = alone.run("--dry-run")
    assert again.output.split() == ["lift", "skip", "up", "to", "date"]
    assert "up to date" in invoke("status", str(alone.output)).output


def test_its_results_can_be_shown_and_made_again_from_the_resolved_recipe(alone):
    alone.run()
    assert "draws" in invoke("show", str(alone.output / "01_lift.h5")).output
    first = json.loads((alone.output / "results.json").read_text())
    alone.recipe.write_text((alone.output / "recipe.resolved.yaml").read_text())
    assert alone.run("--force").exit_code == 0
    assert json.loads((alone.output / "results.json").read_text()) == first


def test_an_input_given_to_it_is_refused(alone):
    result = alone.run("--input", f"cube={alone.data}")
    assert result.exit_code == 2 and "unknown input 'cube'; the recipe has no inputs" in result.output


@pytest.mark.slow
def test_a_changed_seed_is_the_reason_to_do_it_again(alone):
    alone.run()
    assert "seed changed 0 -> 4" in alone.run("--dry-run", "--seed", "4").output
