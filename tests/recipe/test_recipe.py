"""Recipes are checked before anything runs, and every mistake is reported where it stands."""

import sys
from pathlib import Path

import pytest
import yaml
from conftest import RECIPE
from helpers import paths

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.recipe import load_recipe

COMPANION = {"flux_ratio": 0.04, "sep_mas": 150.0, "pa_deg": 300.0}
RECIPES = sorted((paths.RECIPES).glob("*.yaml"))
SAMPLED = [path for path in RECIPES if "samples" in yaml.safe_load(path.read_text())]


def error_lines(bench, text: str = RECIPE, **changes) -> list[str]:
    """Lines of the error that a recipe raises, with the file's name for its path."""
    bench.recipe.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_recipe(bench.recipe, **changes)
    return str(caught.value).replace(f"{bench.recipe}:", "recipe.yaml:").splitlines()


def test_a_recipe_takes_defaults_for_what_it_does_not_say(bench):
    recipe = load_recipe(bench.recipe)
    assert recipe.stages == ("ingest", "calibrate", "lift")
    assert recipe.configs["calibrate"].jitter_sigma_mas == 5.0
    assert (recipe.instrument.name.lower(), recipe.seed) == ("irlos", 0)


def test_all_mistakes_are_reported_at_once_in_the_order_of_the_file(bench):
    text = RECIPE + "  jiter_sigma_mas: 3\n  solver: {iterations: 0}\nseed: -1\ninstrumnt: x\n"
    lines = error_lines(bench, text.replace("cube: data", "cube: gone"))
    assert [line.split(": ")[0] for line in lines] == [f"recipe.yaml:{n}" for n in (4, 8, 9, 10, 11)]


@pytest.mark.parametrize(
    ("addition", "expected"),
    [
        ("instrumnt: x", "recipe.yaml:8: unknown key 'instrumnt'; did you mean 'instrument'?"),
        (
            "  jitter_sigma_mas: 5 mas",
            "recipe.yaml:8: calibrate.jitter_sigma_mas = '5 mas': should be a valid number, unable to parse "
            "string as a number; give a plain number, its unit is in the name of the key",
        ),
        ("seed: 1\nsamples: {cub: ramp}", "recipe.yaml:9: unknown input 'cub'"),
        ("lift: 3", "recipe.yaml:8: lift = 3: should be a section of 'key: value' lines"),
        ("correct: {}", "recipe.yaml:8: section 'correct' has no effect: no such stage under 'stages'"),
        ("instrument: irlso", "recipe.yaml:8: unknown instrument 'irlso'; did you mean 'irlos'?"),
    ],
)
def test_a_mistake_is_reported_with_file_line_and_suggestion(bench, monkeypatch, addition, expected):
    if addition.startswith("correct"):
        monkeypatch.setitem(
            sys.modules, "irlos_pipe.stages.correct", sys.modules["irlos_pipe.stages.lift.stage"]
        )
    (line,) = error_lines(bench, RECIPE + addition + "\n", samples="samples" in addition)
    assert line.startswith(expected)


def test_the_input_of_a_stage_is_one_of_the_recipe():
    text = r"^--set calibrate.input: unknown input 'calibratoin'; did you mean 'calibration'\?$"
    with pytest.raises(ConfigurationError, match=text):
        load_recipe("ncpa_calibration", ["calibrate.input=calibratoin"], needed="given")


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        ("[ingest, calibrat]", "unknown stage 'calibrat'; did you mean 'calibrate'?"),
        ("[ingest, ingest, calibrate]", "stage 'ingest' is listed twice"),
        ("[ingest, lift, calibrate]", "stage 'calibrate' must come before 'lift'"),
        ("[calibrate]", "stage 'calibrate' needs 'ingest' before it"),
        ("[]", "stages = []: list should have at least 1 item"),
    ],
)
def test_wrong_stages_are_reported(bench, stages, expected):
    text = RECIPE.replace("[ingest, calibrate, lift]", stages)
    assert error_lines(bench, text)[0].startswith(f"recipe.yaml:5: {expected}")


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (
            "calibrat.method=dip_avg",
            "--set calibrat.method: unknown key 'calibrat'; did you mean 'calibrate'?",
        ),
        (
            "calibrate.method=dip_globl",
            "--set calibrate.method: calibrate.method = 'dip_globl': should be 'dip_avg' or 'dip_global'; "
            "did you mean 'dip_global'?",
        ),
        ("recipe.name=x", "--set recipe.name: there is a plain value"),
        ("seed=x", "--set seed: seed = 'x': should be a valid integer"),
    ],
)
def test_a_wrong_setting_is_reported_by_its_option(bench, setting, expected):
    (line,) = error_lines(bench, settings=[setting])
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (["cub=data"], "--input cub: unknown input 'cub'; did you mean 'cube'?"),
        (["cube"], "--input cube: expected NAME=PATH"),
        (["cube=/nowhere"], "--input cube: input 'cube': no such file or folder: /nowhere"),
    ],
)
def test_a_wrong_input_is_reported_by_its_option(bench, inputs, expected):
    (line,) = error_lines(bench, inputs=inputs)
    assert line.startswith(expected)


@pytest.mark.parametrize(
    "setting", ["lift.modes=[4,100000]", "sensitivity.mag_step=1e-300", "model.pupil_samples=1000000"]
)
def test_what_would_take_all_memory_or_time_is_refused_before_work_begins(setting):
    with pytest.raises(ConfigurationError) as found:
        load_recipe("sensitivity", [setting], samples=True)
    assert all(line.startswith(f"--set {setting.split('=')[0]}: ") for line in str(found.value).splitlines())


def test_settings_are_yaml_and_the_last_one_counts(bench):
    settings = [
        "calibrate.method=dip_avg",
        "calibrate.method=dip_global",
        "model.effects=[seeing_halo]",
        "calibrate.jitter_sigma_mas=1e1",
    ]
    recipe = load_recipe(bench.recipe, settings, seed=7)
    assert recipe.seed == 7 and recipe.configs["calibrate"].method == "dip_global"
    assert recipe.configs["calibrate"].jitter_sigma_mas == 10
    assert list(recipe.model.effects) == ["seeing_halo"]


def test_a_section_can_be_taken_from_a_file(bench, monkeypatch):
    section = {"effects": [{"companion": COMPANION}], "pupil_samples": 96}
    (bench.data / "model.yaml").write_text(yaml.safe_dump(section))
    monkeypatch.chdir(bench.data)
    settings = ["model.pupil_samples=64", "model=model.yaml", "model.cutoff_per_m=3"]
    model = load_recipe(bench.recipe, settings).model
    assert (model.pupil_samples, model.cutoff_per_m) == (96, 3.0)
    assert [(one.name, one.values) for one in model.entries()] == [("companion", COMPANION)]


def test_the_resolved_recipe_says_everything_and_means_the_same(bench, tmp_path):
    recipe = load_recipe(bench.recipe, settings=["calibrate.solver.iterations=3"])
    copy = tmp_path / "elsewhere" / "resolved.yaml"
    copy.parent.mkdir()
    copy.write_text(recipe.resolved_yaml())
    again = load_recipe(copy)
    assert (again.configs, again.model, again.inputs) == (recipe.configs, recipe.model, recipe.inputs)
    assert (again.instrument, again.stages, again.seed) == (recipe.instrument, recipe.stages, recipe.seed)
    assert yaml.safe_load(copy.read_text())["lift"] == {"calibrated": True}


def test_a_file_that_is_no_recipe_is_reported_in_one_line(bench):
    assert len(error_lines(bench, "just text\n")) == 1
    bench.recipe.unlink()
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_recipe(bench.recipe)


@pytest.mark.parametrize("path", SAMPLED, ids=lambda path: path.stem)
def test_a_recipe_of_the_project_takes_samples_only_if_asked_to(path):
    with pytest.raises(ConfigurationError, match=r"is not given; add --input .*, or --samples"):
        load_recipe(path)
    recipe = load_recipe(path.stem, samples=True)
    assert recipe.path == path and recipe.samples == tuple(recipe.inputs)
    assert "simulated sample" in recipe.notice


def test_a_file_goes_before_a_name_and_an_unknown_name_is_corrected(bench, monkeypatch):
    monkeypatch.chdir(bench.folder)
    Path("modes").write_text(RECIPE)
    assert load_recipe("modes").name == "test"
    Path("diagnose").mkdir()
    assert load_recipe("diagnose", needed="given").name == "diagnose"
    with pytest.raises(ConfigurationError, match="did you mean 'derotator'"):
        load_recipe("derotatr")
