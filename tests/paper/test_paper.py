"""`irlos paper`: every recipe of a folder run on its own, one report and one file of numbers on all."""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from conftest import invoke
from helpers import fake_stages
from helpers.fake_stages import COUNTS
from helpers.paths import RECIPES
from pydantic import Field

import irlos_pipe.report.build  # noqa: F401 - before a stand-in takes the place of what it imports
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.common.table import read_csv
from irlos_pipe.paper.run.run import find_experiments
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.report import build
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import svg
from irlos_pipe.stages import EXPERIMENTS
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

RECIPE = """\
recipe: {name}
title: The {name} experiment
stages: [{stage}]
{stage}:
  samples: 200
seed: 3
"""
QUICK = """\
zeta: {calibrate.samples: 10}
alpha: {lift.samples: 20, seed: 4}
"""


class Config(StageConfig):
    samples: int = Field(5, ge=1)
    limit: float = Field(10.0, description="largest mean that passes")
    fails: bool = False


def run(ctx: StageContext) -> StageOutput:
    """Draw numbers; two stages of a recipe folder do the same under two names."""
    fake_stages.COUNTS[ctx.log.name.rpartition(".")[2]] += 1
    if ctx.config.fails:
        raise InputDataError("the star is gone")
    draws = np.random.default_rng(ctx.seed).normal(size=ctx.config.samples)
    check = Check("mean", draws.mean(), "nm", None, ctx.config.limit, "the mean is small")
    rows = [{"name": "a", "median_nm": float(np.median(draws))}]
    results = fake_stages.FreeResults(mean_nm=draws.mean(), tables={"draws": rows})
    return StageOutput({"draws": Quantity(draws, "nm")}, results, [check], summary=["a few draws"])


def section(data) -> Section:
    """The same drawing for every experiment that has this stage."""
    line = svg("line", (3, 2), lambda figure: figure.subplots().plot([0, 1], label="line"))
    mean = f"{data.products['lift'].results['mean_nm']:.4f} nm"
    return Section("lift", "Draws", "Some draws.", [Figure(line, "A line"), Table(("mean",), [(mean,)])])


@dataclass
class PaperBench:
    """Recipes `zeta` (stage calibrate) and `alpha` (stage lift), and where they run."""

    folder: Path

    @property
    def recipes(self) -> Path:
        return self.folder / "recipes"

    @property
    def output(self) -> Path:
        return self.folder / "out"

    def paper(self, *options: str) -> Result:
        return invoke(
            "paper", "--output", str(self.output), "--recipes", str(self.recipes), "--jobs", "1", *options
        )

    def numbers(self) -> dict[str, str]:
        """Files of numbers by name, but for the one that changes from run to run."""
        files = sorted((self.output / "tables").glob("*.csv"))
        return {file.stem: file.read_text() for file in files if file.stem != "runs"}

    def runs(self) -> list[dict[str, str]]:
        return read_csv(self.output / "tables/runs.csv")

    def page(self) -> str:
        return (self.output / "report.html").read_text()

    def set(self, name: str, line: str) -> None:
        path = self.recipes / f"{name}.yaml"
        path.write_text(path.read_text().replace("  samples", f"  {line}\n  samples"))


def make(folder: Path, monkeypatch) -> PaperBench:
    """Put the stand-ins in place and write the recipes; file names are not in the order of the stages."""
    modules = fake_stages.modules()
    for name in ("calibrate", "lift"):
        module = modules[f"irlos_pipe.stages.{name}.stage"]
        module.__dict__.update(Config=Config, run=run, NEEDS=(), READS=(), DEPENDS_ON={"seed"})
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(build, "SECTIONS", {"lift": section})
    fake_stages.COUNTS.clear()
    bench = PaperBench(folder)
    bench.recipes.mkdir()
    for name, stage in (("zeta", "calibrate"), ("alpha", "lift")):
        (bench.recipes / f"{name}.yaml").write_text(RECIPE.format(name=name, stage=stage))
    (bench.recipes / "quick.yaml").write_text(QUICK)
    return bench


@pytest.fixture
def paper(tmp_path, monkeypatch) -> PaperBench:
    return make(tmp_path, monkeypatch)


def names(paper: PaperBench) -> list[str]:
    return [run["experiment"] for run in paper.runs()]


def test_the_numbers_are_those_of_the_seed_with_sizes_and_checks_in_the_order_of_the_stages(paper):
    result = paper.paper()
    assert result.exit_code == 0, result.output
    draws = np.random.default_rng(3).normal(size=200)
    assert paper.numbers()["alpha"] == f"table,name,median_nm\ndraws,a,{np.median(draws)}\n"
    assert names(paper) == re.findall(r'<article id="(\w+)"', paper.page()) == ["zeta", "alpha"]
    alpha = paper.runs()[1]
    assert [alpha[key] for key in ("stage", "seed", "quick", "jobs")] == ["lift", "3", "False", "1"]
    assert json.loads(alpha["sizes"]) == {"samples": 200, "limit": 10.0, "fails": False}
    check = paper.numbers()["checks"].splitlines()[2]
    assert check == f"alpha,mean,True,{draws.mean()},nm,,10.0,the mean is small"


def test_an_experiment_that_fails_does_not_stop_the_others_and_the_exit_code_is_5(paper):
    paper.set("zeta", "fails: true")
    result = paper.paper()
    assert result.exit_code == 5
    assert "irlos: error: zeta: the star is gone" in result.output
    assert names(paper) == ["alpha"]
    assert "the star is gone" in paper.page() and "The alpha experiment" in paper.page()


@pytest.mark.slow
def test_an_interruption_keeps_what_is_finished_and_the_next_run_goes_on(paper, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["irlos_pipe.stages.lift.stage"], "run", interrupted)
        assert paper.paper().exit_code == 130
    assert names(paper) == ["zeta"]
    assert paper.paper().exit_code == 0
    assert COUNTS["calibrate"] == COUNTS["lift"] == 1 and names(paper) == ["zeta", "alpha"]


def test_a_report_that_cannot_be_drawn_does_not_keep_the_others_from_the_page(paper, monkeypatch):
    def broken(_):
        raise KeyError("median")

    monkeypatch.setitem(build.SECTIONS, "lift", broken)
    assert paper.paper().exit_code == 5
    assert "cannot be shown: KeyError" in paper.page() and "a few draws" in paper.page()


@pytest.mark.slow
def test_one_experiment_can_be_run_alone_and_others_are_left_out_when_they_are_out_of_date(paper):
    paper.paper("--only", "alpha")
    assert COUNTS["calibrate"] == 0 and names(paper) == ["alpha"]
    paper.paper("--only", "zeta")
    assert COUNTS["lift"] == 1 and names(paper) == ["zeta", "alpha"]
    paper.set("alpha", "limit: 11")
    paper.paper("--only", "zeta")
    assert names(paper) == ["zeta"] and "alpha" not in paper.numbers()
    assert "The alpha experiment" not in paper.page()


@pytest.mark.slow
@pytest.mark.parametrize(("first", "then", "held"), [(["--quick"], [], "--quick"), ([], ["--quick"], "full")])
def test_quick_runs_have_the_sizes_of_their_file_and_no_place_beside_full_ones(paper, first, then, held):
    assert paper.paper(*first).exit_code == 0
    runs = paper.runs()
    sizes = {run["experiment"]: (json.loads(run["sizes"])["samples"], run["seed"]) for run in runs}
    quick = {"zeta": (10, "3"), "alpha": (20, "4")}
    assert sizes == (quick if first else {"zeta": (200, "3"), "alpha": (200, "3")})
    refused = paper.paper(*then)
    assert refused.exit_code == 2 and f"holds {held} experiments" in refused.output
    assert paper.runs() == runs


@pytest.mark.parametrize(("option", "value"), [("--only", "alfa"), ("--recipes", "nowhere")])
def test_a_mistake_gives_one_line_before_anything_runs(paper, option, value):
    result = paper.paper(option, value)
    (line,) = result.output.splitlines()
    assert result.exit_code == 2 and line.startswith(f"irlos: error: {option} {value}: no ")
    assert not paper.output.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("zetta: {calibrate.samples: 1}", ":1: no recipe 'zetta'; did you mean 'zeta'?"),
        ("zeta: {calibrate.sampels: 1}", ": calibrate.sampels: unknown key 'calibrate.sampels'; did you"),
    ],
)
def test_a_mistake_in_the_quick_settings_is_reported_with_its_line(paper, content, message):
    path = paper.recipes / "quick.yaml"
    path.write_text(content)
    result = paper.paper("--quick")
    assert result.exit_code == 2 and f"irlos: error: {path}{message}" in result.output


@pytest.mark.parametrize("quick", [False, True])
def test_the_recipes_that_come_with_the_sources_are_valid_and_have_quick_sizes(quick):
    found = find_experiments(RECIPES / "paper", quick=quick)
    assert [one.recipe.stages[-1] for one in found] == list(EXPERIMENTS)
    assert set(load_yaml(RECIPES / "paper/quick.yaml")[0]) == {one.name for one in found}
