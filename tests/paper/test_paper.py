"""`irlos paper`: every recipe of a folder run on its own, one report and one file of numbers on all."""

import json
import re
import sys

import numpy as np
import pytest
from conftest import invoke
from helpers import paper_bench
from helpers.fake_stages import COUNTS
from helpers.paper_bench import PaperBench
from helpers.paths import PACKAGE, RECIPES

from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.run.recipes import find_experiments
from irlos_pipe.stages import EXPERIMENTS, STAGES


@pytest.fixture
def paper(tmp_path, monkeypatch) -> PaperBench:
    return paper_bench.make(tmp_path, monkeypatch)


def names(paper: PaperBench) -> list[str]:
    return [run["experiment"] for run in paper.runs()]


@pytest.mark.slow
def test_every_experiment_has_a_run_of_its_own_and_a_place_in_the_common_files(paper):
    result = paper.paper()
    assert result.exit_code == 0, result.output
    for name in ("alpha", "zeta"):
        assert (paper.output / name / "report.html").is_file()
        assert (paper.output / name / "results.json").is_file()
    assert names(paper) == ["zeta", "alpha"]  # as their stages are listed
    assert re.findall(r'<article id="(\w+)"', paper.page()) == ["zeta", "alpha"]


def test_the_numbers_are_those_of_the_seed_with_sizes_and_checks(paper):
    paper.paper()
    draws = np.random.default_rng(3).normal(size=200)
    assert paper.numbers()["alpha"] == f"table,name,median_nm\ndraws,a,{np.median(draws)}\n"
    alpha = paper.runs()[1]
    assert (alpha["experiment"], alpha["stage"], alpha["seed"], alpha["quick"]) == (
        "alpha",
        "lift",
        "3",
        "False",
    )
    assert json.loads(alpha["sizes"]) == {"samples": 200, "limit": 10.0, "fails": False}
    assert (
        paper.numbers()["checks"].splitlines()[2]
        == f"alpha,mean,True,{draws.mean()},nm,,10.0,the mean is small"
    )


@pytest.mark.slow
def test_what_differs_from_run_to_run_stands_apart_and_no_path_stands_anywhere(paper, tmp_path):
    paper.paper()
    text = (paper.output / "tables/runs.csv").read_text()
    assert str(tmp_path) not in text and str(paper.output) not in text
    made = paper.runs()[1]
    assert made["jobs"] == "1" and made["code"] and made["finished"] and "numpy" in made["software"]
    other = PaperBench(tmp_path / "again")
    other.folder.mkdir()
    other.recipes.symlink_to(paper.recipes)
    other.paper()
    assert other.numbers() == paper.numbers()


@pytest.mark.slow
def test_a_second_run_works_on_nothing_and_changes_nothing(paper):
    paper.paper()
    before = (paper.page(), paper.numbers())
    assert paper.paper().exit_code == 0
    assert COUNTS["lift"] == COUNTS["calibrate"] == 1
    assert (paper.page(), paper.numbers()) == before


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


def test_a_failed_limit_is_exit_code_4_and_named_in_the_numbers(paper):
    paper.set("zeta", "limit: -5")
    assert paper.paper().exit_code == 4
    assert paper.numbers()["checks"].splitlines()[1].startswith("zeta,mean,False,")


def test_a_report_that_cannot_be_drawn_does_not_keep_the_others_from_the_page(paper, monkeypatch):
    def broken(_):
        raise KeyError("median")

    monkeypatch.setitem(paper_bench.build.SECTIONS, "lift", broken)
    assert paper.paper().exit_code == 5
    assert "cannot be shown: KeyError" in paper.page() and "a few draws" in paper.page()


@pytest.mark.slow
def test_one_experiment_can_be_run_alone_and_the_others_stay_in_the_files(paper):
    paper.paper("--only", "alpha")
    assert COUNTS["calibrate"] == 0 and names(paper) == ["alpha"]
    paper.paper("--only", "zeta")
    assert COUNTS["lift"] == 1 and names(paper) == ["zeta", "alpha"]


@pytest.mark.slow
def test_others_that_are_out_of_date_are_left_out(paper):
    paper.paper()
    paper.set("alpha", "limit: 11")
    paper.paper("--only", "zeta")
    assert names(paper) == ["zeta"] and "alpha" not in paper.numbers()
    assert "The alpha experiment" not in paper.page()


@pytest.mark.slow
def test_quick_changes_sizes_as_the_file_says_and_takes_another_folder(paper):
    assert paper.paper("--quick").exit_code == 0
    runs = paper.runs()
    sizes = {run["experiment"]: json.loads(run["sizes"])["samples"] for run in runs}
    assert {run["quick"] for run in runs} == {"True"} and sizes == {"zeta": 10, "alpha": 20}
    assert runs[1]["seed"] == "4"
    refused = paper.paper()
    assert refused.exit_code == 2 and "holds --quick experiments" in refused.output
    assert paper.runs() == runs


@pytest.mark.slow
def test_a_quick_run_does_not_replace_the_full_one(paper):
    paper.paper()
    refused = paper.paper("--quick")
    assert refused.exit_code == 2 and "holds full experiments" in refused.output and COUNTS["lift"] == 1


def test_a_seed_given_replaces_that_of_every_recipe(paper):
    paper.paper("--seed", "8")
    assert {run["seed"] for run in paper.runs()} == {"8"}


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


def test_a_recipe_that_is_not_wanted_may_be_wrong(paper):
    paper.set("zeta", "nonsense: 1")
    assert paper.paper().exit_code == 2
    assert paper.paper("--only", "alpha").exit_code == 0


@pytest.mark.slow
def test_drawings_of_two_experiments_with_the_same_stage_have_identifiers_of_their_own(paper):
    (paper.recipes / "beta.yaml").write_text(paper_bench.RECIPE.format(name="beta", stage="lift"))
    paper.paper()
    identifiers = re.findall(r'\sid="([^"]*)"', paper.page())
    assert len(identifiers) == len(set(identifiers)) and any("beta-line" in one for one in identifiers)
    wanted = set(re.findall(r'href="#([^"]*)|url\(#([^)]*)', paper.page()))
    assert {one or other for one, other in wanted} <= set(identifiers)


def test_the_page_is_one_file_with_contents_sizes_seed_and_machine(paper):
    paper.paper()
    page = paper.page()
    assert not re.search(r"<script|<link|@import|src=", page)
    assert '<a href="#alpha">The alpha experiment</a>' in page
    for shown in ("samples 200", "lift.limit", "Some draws.", "numpy", "Machine and software"):
        assert shown in page


def test_the_folder_of_a_run_in_progress_is_left_alone(paper):
    from irlos_pipe.product.runfolder import owned_folder

    with owned_folder(paper.output):
        assert paper.paper().exit_code == 75


@pytest.mark.parametrize("quick", [False, True])
def test_the_recipes_that_come_with_the_sources_are_valid_and_each_has_a_section(quick):
    found = find_experiments(RECIPES / "paper", quick=quick)
    assert all(one.recipe.title for one in found)
    assert [one.recipe.stages[-1] for one in found] == list(EXPERIMENTS)
    assert all(callable(STAGES[name].section) for name in EXPERIMENTS)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_imports_from_no_other(name):
    source = (PACKAGE / "paper" / f"{name}.py").read_text()
    assert set(re.findall(r"from irlos_pipe\.paper(?:\.(\w+)| import (\w+))", source)) <= {
        ("common", ""),
        ("", "experiment"),
    }


def test_every_experiment_has_quick_sizes():
    sizes, _ = load_yaml(RECIPES / "paper/quick.yaml")
    assert set(sizes) == {one.name for one in find_experiments(RECIPES / "paper")}


def test_the_help_shows_how_to_begin():
    text = invoke("paper", "--help").output
    assert "irlos paper --output runs/paper-quick --quick" in text and "checks.csv" in text
