"""`irlos paper`: every recipe of a folder run on its own, one report and one file of numbers on all."""

import json
import re
import sys

import numpy as np
import pytest
from helpers import paper_bench
from helpers.fake_stages import COUNTS
from helpers.paper_bench import PaperBench
from helpers.paths import RECIPES

from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.run.run import find_experiments
from irlos_pipe.stages import EXPERIMENTS


@pytest.fixture
def paper(tmp_path, monkeypatch) -> PaperBench:
    return paper_bench.make(tmp_path, monkeypatch)


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

    monkeypatch.setitem(paper_bench.build.SECTIONS, "lift", broken)
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


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--only", "alfa"), "irlos: error: --only alfa: no such experiment; did you mean 'alpha'?"),
        (
            ("--recipes", "nowhere"),
            "irlos: error: --recipes nowhere: no recipes there; give a folder "
            "of recipes, or leave the option out",
        ),
    ],
)
def test_a_mistake_gives_one_line_before_anything_runs(paper, options, line):
    result = paper.paper(*options)
    assert (result.exit_code, result.output.splitlines()) == (2, [line])
    assert not paper.output.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("zetta: {calibrate.samples: 1}", ":1: no recipe 'zetta'; did you mean 'zeta'?"),
        ("zeta: 3", ":1: 'zeta' should be a section of 'stage.key: value' lines"),
        ("zeta: {calibrate.sampels: 1}", ": calibrate.sampels: unknown key 'calibrate.sampels'; did you"),
        ("zeta: {calibrate.samples: 0}", ": calibrate.samples: calibrate.samples = 0"),
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
