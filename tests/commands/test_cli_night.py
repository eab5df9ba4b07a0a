"""`irlos night` as its user, or cron, meets it; work is done in this process by stand-in stages."""

import json

import pytest
from conftest import invoke
from helpers.night_bench import night_bench  # noqa: F401 - the fixture `bench`

from irlos_pipe.night import engines

MORNING = "2024-02-11T03:00:00"


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr(engines, "local_runner", lambda jobs: map)


def night(bench, *options: str):
    recipes = [option for recipe in bench.recipes for option in ("--recipe", recipe)]
    return invoke("night", str(bench.archive), "--output", str(bench.tree), *recipes, *options)


def test_nothing_is_printed_when_all_is_well(bench):
    bench.record(MORNING)
    for _ in range(2):
        result = night(bench)
        assert (result.exit_code, result.output) == (0, "")


def test_one_line_states_what_is_wrong_and_where_to_look(bench):
    (bench.record(MORNING) / "ingest.bad_data").touch()
    bench.record("2024-02-11T04:00:00", "other", {"4": 500.0})
    result = night(bench)
    assert result.stdout == ""
    assert (result.exit_code, result.stdout) == (5, "")
    assert result.stderr == (
        "irlos: error: night 2024-02-10: 2024-02-10/030000_cube/cube: cube.fits: HDU 1 is truncated "
        f"(and 1 more); see {bench.tree}/night_2024-02-10.html\n"
    )
    bench.record("2024-02-12T03:00:00", numbers={"4": 500.0})
    assert night(bench).stderr == (
        f"irlos: error: 2 of 2 nights need a look (2024-02-10, 2024-02-11); see {bench.tree}/night_*.html\n"
    )


def test_an_empty_night_is_exit_code_64_silent_for_cron_and_reported_with_v(bench):
    result = night(bench)
    assert (result.exit_code, result.output) == (64, "")
    assert len(list(bench.tree.glob("night_*.html"))) == 1
    for options in ([], ["--dry-run"]):
        result = night(bench, "--json", *options)
        content = json.loads(result.stdout)
        assert result.exit_code == content["exit_code"] == 64
        assert content["nights"] == [] and "no recordings" in content["nothing"]
    assert night(bench, "-v").stderr == f"irlos: error: {bench.archive}: no recordings\n"


def test_what_was_done_is_listed_as_text_and_as_json(bench):
    bench.record(MORNING)
    planned = night(bench, "--dry-run").stdout
    assert planned == "2024-02-10/030000_cube/cube  all stages  run  no products yet\n"
    assert not bench.tree.exists()
    result = night(bench, "-v")
    assert result.stdout.splitlines()[0].split() == ["2024-02-10", "030000_cube/cube", "ok", "new"]
    assert "1 of 1: 2024-02-10/030000_cube/cube: new in" in result.stderr
    content = json.loads(night(bench, "--json").stdout)
    assert content["exit_code"] == 0 and content["nights"][0]["recordings"] == 1
    assert content["nights"][0]["reductions"][0]["action"] == "up to date"
    steps = json.loads(night(bench, "--dry-run", "--json").stdout)
    assert [one["action"] for one in steps] == 3 * ["skip"]


def test_a_dry_run_names_what_it_could_not_reduce(bench):
    bench.record(MORNING)
    damaged = bench.record("2024-02-11T04:00:00", "torn") / "torn.fits"
    damaged.write_bytes(damaged.read_bytes()[:3000])
    rows = json.loads(night(bench, "--dry-run", "--json").stdout)
    assert [row["run"] for row in rows] == ["2024-02-10/030000_cube/cube", "left out"]
    assert "torn.fits" in rows[-1]["reason"] and "torn.fits" in night(bench, "--dry-run").stdout


def config(bench, text: str) -> str:
    path = bench.folder / "night.yaml"
    path.write_text(text)
    return str(path)


def test_a_config_names_recipes_beside_it_and_changes_their_settings(bench):
    bench.record(MORNING, numbers={"4": 500.0})
    text = "recipes: {calibration: [cube.yaml], ramp: []}\nsettings: {cube: {calibrate.limit: 600}}\n"
    arguments = ("night", str(bench.archive), "--output", str(bench.tree), "--config", config(bench, text))
    assert invoke(*arguments).exit_code == 0
    recipe = bench.run_folder() / "recipe.resolved.yaml"
    assert "limit: 600.0" in recipe.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("recipes: {calibraton: []}", "night.yaml:1: recipes.calibraton"),
        ("recepes: {}", "night.yaml:1: unknown key 'recepes'; did you mean 'recipes'?"),
        ("settings: {cub: {}}", "settings.cub: no such recipe"),
        ("band: {limits: {ncpa_nmm: [0, 20]}}", "is no number of a trend; did you mean 'ncpa_nm'"),
        ("band: {limits: {noll_4_nm: [20, -20]}}", "not below"),
        ("settings: {cube: {calibrate.limt: 1}}", "unknown key 'calibrate.limt'; did you mean 'limit'?"),
    ],
)
def test_a_mistake_in_the_config_is_reported_with_its_line(bench, text, message):
    bench.record(MORNING)
    result = night(bench, "--config", config(bench, text))
    assert result.exit_code == 2 and message in result.stderr


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        ("cube.yaml", "expected KIND=PATH"),
        ("rmp=cube.yaml", "no such kind of group; did you mean 'ramp'?"),
        ("calibration=absent.yaml", "absent.yaml: cannot be read"),
    ],
)
def test_a_mistake_in_a_recipe_option_is_reported_in_one_line(bench, recipe, message):
    bench.record(MORNING)
    result = invoke("night", str(bench.archive), "--output", str(bench.tree), "--recipe", recipe)
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1
