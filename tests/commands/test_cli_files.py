"""A file finds its instrument, recipe and role; what cannot be decided is one line that says what to do."""

import json
import re

import jsonschema
import pytest
import yaml
from astropy.io import fits
from conftest import invoke
from helpers.sparta_files import SIDECAR, counts, star

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.instrument.instrument import PROFILES
from irlos_pipe.recipe import load_recipe
from irlos_pipe.reference import COMMANDS

CUBE = counts(star(16, 16), frames=3)


def write(path, seed=0, **keys):
    """A plain cube with its side-car; without a role it has none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fits.writeto(path, CUBE + seed)
    if keys:
        path.with_suffix(".yaml").write_text(yaml.safe_dump(SIDECAR | keys))
    return path


@pytest.fixture
def own(tmp_path):
    """A profile of one's own."""
    path = tmp_path / "profiles" / "own.yaml"
    path.parent.mkdir()
    path.write_text((PROFILES / "irlos.yaml").read_text().replace("name: irlos", "name: own"))
    return path


def loaded(*paths, settings=(), recipe="ncpa_calibration"):
    return load_recipe(recipe, settings, [f"calibration={path}" for path in paths])


@pytest.mark.parametrize("given", ["file", "folder"])
def test_the_side_car_states_the_instrument_and_the_command_line_wins(tmp_path, own, given):
    cube = write(tmp_path / "data" / "a.fits", role="ncpa_calibration", instrument="../profiles/own.yaml")
    path = cube if given == "file" else cube.parent
    write(tmp_path / "data" / "dark.fits", 1, role="dark")  # one that states none contradicts nobody
    found = loaded(path)
    assert (found.instrument.name, found.instrument_name) == ("own", str(own))
    assert found.instrument_text == "own (side-car a.yaml)"
    won = loaded(path, settings=["instrument=bench"])
    assert won.instrument.name == "bench" and "a.yaml states" in won.instrument_text
    again = tmp_path / "resolved.yaml"
    again.write_text(won.resolved_yaml())
    assert load_recipe(again).instrument.name == "bench"  # a run can be repeated
    (tmp_path / "data" / "a.yaml").write_text("instrument: [bench/a.yaml]\n")  # ingest says what is wrong
    assert loaded(path).instrument_text.startswith("irlos (nobody states another")


def test_instruments_that_contradict_each_other_or_are_unknown_are_one_line(tmp_path):
    first = write(tmp_path / "a.fits", role="ncpa_calibration", instrument="bench")
    second = write(tmp_path / "b.fits", 1, role="ncpa_calibration", instrument="pharo")
    with pytest.raises(InputDataError, match=r"a\.yaml: instrument = bench, but .*b\.yaml states pharo; "):
        loaded(first, second)
    assert loaded(first, second, settings=["instrument=irlos"]).instrument.name == "irlos"
    third = write(tmp_path / "c.fits", role="ncpa_calibration", instrument="farow")
    with pytest.raises(InputDataError, match=r"c\.yaml: unknown instrument 'farow'; did you mean 'pharo'"):
        loaded(third)


def test_a_new_side_car_states_the_instrument_as_seen_from_its_folder(tmp_path, own, monkeypatch):
    cube = write(tmp_path / "data" / "a.fits")
    monkeypatch.chdir(own.parent)
    assert invoke("sidecar", str(cube), "--instrument", "own.yaml").exit_code == 0
    assert "\ninstrument: ../profiles/own.yaml  #" in cube.with_suffix(".yaml").read_text()
    assert loaded(cube).instrument.name == "own"


def test_a_run_says_which_instrument_it_took(bench):
    assert "irlos: instrument: irlos (nobody states another" in bench.run().stderr
    assert json.loads((bench.output / "results.json").read_text())["instrument"] == "irlos"
    assert "instrument: irlos" in (bench.output / "run.log").read_text()


def files(folder, *roles):
    focus = [
        {"introduced_defocus_nm": 100.0 * n} if one == "defocus_ramp" else {} for n, one in enumerate(roles)
    ]
    named = [(folder / f"{n}.fits", n) for n in range(len(roles))]
    return [str(write(*one, role=role, **nm)) for one, role, nm in zip(named, roles, focus, strict=True)]


@pytest.mark.parametrize(
    ("roles", "recipe", "inputs"),
    [
        (["ncpa_calibration"], "ncpa_calibration", {"calibration": ["0"]}),
        (["ncpa_calibration", "dark"], "ncpa_calibration", {"calibration": ["0", "1"]}),
        (["derotator", "derotator"], "derotator", {"cube": ["0", "1"]}),
        (
            ["defocus_ramp", "defocus_ramp", "defocus_ramp", "ncpa_calibration"],
            "defocus_ramp",
            {"ramp": ["0", "1", "2"], "calibration": ["3"]},
        ),
    ],
)
def test_reduce_finds_recipe_and_inputs_and_says_the_command_that_does_the_same(
    tmp_path, roles, recipe, inputs
):
    result = invoke("reduce", *files(tmp_path, *roles), "--dry-run", "--output", str(tmp_path / "out"))
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("irlos run ")]
    found = re.findall(r"--input (\w+)=\S*/(\d)\.fits", line)
    assert result.exit_code == 0 and line.split()[2] == recipe
    assert {name: [file for its, file in found if its == name] for name, _ in found} == inputs
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("roles", "code", "message"),
    [
        (["ncpa_calibration"] * 2, 2, "2 reductions, not one: 0 (calibration), 1 (calibration)"),
        (["psf"], 2, "no recipe is meant for a recording of role psf; choose one with --recipe"),
        (["defocus_ramp"], 3, "0.fits: a ramp, and no calibration cube"),
        (["dark"], 64, "only darks"),
    ],
)
def test_what_reduce_cannot_decide_is_one_clear_line(tmp_path, roles, code, message):
    result = invoke("reduce", *files(tmp_path, *roles))
    (line,) = result.stderr.splitlines()
    assert result.exit_code == code and message in line


def test_show_says_what_a_file_is_and_what_to_do_with_it(tmp_path):
    cube = write(tmp_path / "a.fits")
    result = invoke("show", str(cube))
    assert result.exit_code == 0 and "3 of 16x16 px" in result.stdout
    assert f"irlos sidecar {cube}" in result.stdout
    assert f"irlos sidecar {cube}" in invoke("reduce", str(cube)).stderr
    (path,) = files(tmp_path / "n", "ncpa_calibration")
    content = json.loads(invoke("show", path, "--json").stdout)
    jsonschema.validate(content, json.loads(COMMANDS.read_text()))
    assert content["recordings"][0]["role"] == "ncpa_calibration, TEST"
    assert content["recordings"][0]["next"] == f"irlos reduce {path}, by recipe ncpa_calibration"
    assert invoke("show", str(tmp_path / "no.fits")).exit_code == 3


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (["run", "full_reduction", "a.fits"], "--input calibration=a.fits or --input ramp=a.fits"),
        (["calibrate", "a.fits"], "irlos run ncpa_calibration"),
        (["diagnose"], "irlos run diagnose"),
        (["validate", "ncpa_calibration", "--set", "pupil_sampels=96"], "'model.pupil_samples'?"),
        (["explain", "corection"], "did you mean 'correction'?"),
    ],
)
def test_what_is_typed_in_the_wrong_place_is_answered_by_the_right_one(command, answer):
    result = invoke(*command)
    assert result.exit_code == 2 and answer in result.stderr


def test_a_recipe_that_states_an_instrument_wins_over_the_side_car(tmp_path):
    cube = write(tmp_path / "a.fits", role="ncpa_calibration", instrument="pharo")
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("instrument: bench\n" + invoke("recipes", "ncpa_calibration").stdout)
    assert (
        loaded(cube, recipe=recipe).instrument_text
        == "bench (mine.yaml:1; not pharo as side-car a.yaml states)"
    )
    with pytest.raises(ConfigurationError, match="unknown instrument"):
        loaded(cube, recipe=recipe, settings=["instrument=benhc"])
