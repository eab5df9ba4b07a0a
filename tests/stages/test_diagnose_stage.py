"""What the stage `diagnose` hands on: results as scripts read them, a model as recipes take it, a section."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from helpers.diagnose_cases import CASE, CONDITIONS, diagnosis_of
from helpers.made_run import recording
from helpers.recordings import recording as made
from helpers.simulation_specs import simulated
from pydantic import ValidationError

from irlos_pipe.commands.main import cli
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.stages.base import EffectEntry, ModelConfig
from irlos_pipe.stages.diagnose.stage import Config, DiagnoseResults
from irlos_pipe.stages.diagnose.work import (
    checks_of,
    model_yaml,
    moments_of,
    recipe_entry,
)
from irlos_pipe.stages.model.effects import pooled_frames

pytestmark = pytest.mark.xdist_group("diagnoses")  # each is made once


@pytest.mark.slow
def test_the_model_with_what_was_found_is_a_valid_section_of_a_recipe():
    entries = [recipe_entry(step.effect) for step in diagnosis_of("companion").steps]
    model = ModelConfig(effects=("tip_tilt_jitter",))
    section = ModelConfig(**yaml.safe_load(model_yaml(model, entries)))
    jitter, companion = section.entries()
    assert (jitter.name, jitter.fit) == ("tip_tilt_jitter", True)
    assert companion.values["flux_ratio"] == pytest.approx(0.03, rel=0.05)
    assert companion.fit


@pytest.mark.slow
def test_the_companion_found_is_one_that_the_recipe_can_place():
    (step,) = diagnosis_of("companion").steps
    made = EffectEntry.of(recipe_entry(step.effect))
    again = type(step.effect.base).under(CONDITIONS).values_of(**made.values)
    assert again == pytest.approx(step.effect.values.tolist())


def test_a_recording_without_frames_is_refused_with_its_name():
    none, good = made(np.zeros((0, *CASE.window)), "short"), np.ones(CASE.window, bool)
    with pytest.raises(InputDataError, match="short: no used frame is left"):
        pooled_frames([none], good, CONDITIONS.settings)


def test_bad_pixels_of_the_model_and_those_found_make_one_list():
    model = ModelConfig(effects=("seeing_halo", {"bad_pixels": {"pixels": [[3, 4]]}}))
    found = [{"bad_pixels": {"pixels": [[1, 2], [3, 4]]}}]
    assert yaml.safe_load(model_yaml(model, found))["effects"] == [
        "seeing_halo",
        {"bad_pixels": {"pixels": [[1, 2], [3, 4]]}},
    ]


@pytest.mark.parametrize(("elements", "of"), [(["J"], {"of": "J"}), (["J", "lens"], {})])
def test_the_wavefront_of_a_filter_becomes_an_entry_that_a_recipe_takes(elements, of):
    kind = CATALOGUE["filter_ncpa"]((5, 6), elements)
    entry = recipe_entry(FixedEffect(kind, np.array([10.0, -20.0])))
    assert entry == {"filter_ncpa": {"zernike_nm": {5: 10.0, 6: -20.0}, **of, "fit": True}}
    assert EffectEntry.of(entry).fit


@pytest.mark.parametrize(
    ("verdict", "grade", "unexplained", "passed"),
    [
        ("none", "none", False, True),
        ("effect", "complete", False, True),
        ("effect", "partial", True, False),
        ("unknown", "resembles", True, False),
        ("unknown", "unknown", True, False),
        ("unknown", "", False, False),  # of a ramp, which has no grade
    ],
)
def test_only_a_diagnosis_that_leaves_nothing_passes(verdict, grade, unexplained, passed):
    results = DiagnoseResults(verdict=verdict, grade=grade, unexplained=unexplained, sentence="What is left.")
    (check,) = checks_of(results)
    assert check.passed is passed
    assert check.message.endswith("What is left.") and verdict in check.message


# A wavefront of another run as a start: the key `begin_near` of a recipe.


CALIBRATED = {"calibrate": {"zernike_nm": {"4": 1.0}, "all_zernike_nm": {"4": 1.5, "40": 2.0}}}
DIAGNOSED = {"diagnose": {"zernike_nm": {"before": {"5": 3.0}, "after": {"5": 4.0}}}}


@pytest.mark.parametrize(
    ("stages", "taken"),
    [
        (CALIBRATED, {4: 1.5, 40: 2.0}),
        (DIAGNOSED, {5: 4.0}),
        (CALIBRATED | DIAGNOSED, {5: 4.0}),
    ],
)
def test_a_run_gives_what_it_found(tmp_path, stages, taken):
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"stages": stages}))
    for path in (tmp_path, results):
        assert Config(begin_near=str(path)).begin_near == taken


@pytest.mark.parametrize("content", ["{", "[]", '{"stages": {"ingest": {}}}'])
def test_a_run_without_a_wavefront_is_refused(tmp_path, content):
    (tmp_path / "results.json").write_text(content)
    with pytest.raises(ValidationError, match=r"results\.json: .*; give a"):
        Config(begin_near=str(tmp_path))


# Which recordings are of one star and night, and how results and report say what they share.


HOUR_S = 3600.0


def taken(target: str, hours: float):
    one = recording("cube", "cube", 2)
    acquisition = replace(one.acquisition, target=target)
    return replace(one, acquisition=acquisition, start_unix_s=one.start_unix_s + hours * HOUR_S)


@pytest.mark.parametrize(
    ("targets", "hours", "expected"),
    [
        ("AAB", (0, 1, 2), [0, 0, 1]),  # another star
        ("ABA", (0, 1, 2), [0, 1, 0]),  # the first star again, the same night
        ("AAA", (0, 8, 24), [0, 0, 1]),  # another night
        ("AAA", (0, 8, 16), [0, 0, 0]),  # 16 h, but never 12 between two
        ("AA", (0, float("nan")), [0, 0]),  # times not known: the targets tell
    ],
)
def test_stars_and_nights_follow_from_targets_and_times(targets, hours, expected):
    recordings = [taken(target, hour) for target, hour in zip(targets, hours, strict=True)]
    assert moments_of(recordings) == expected


# A mirror whose segments are out of step, from raw files to the verdict.
# Truth: the simulator's images of the pupil of Keck, which shares no optics with the model, with pistons
# drawn here, photon and detector noise, and no sky.


PISTON_NM = 20.0 * np.random.default_rng(11).standard_normal(36)
CUBE = {
    "role": "ncpa_calibration",
    "mag_j": 8.0,
    "frames": 40,
    "exposure_s": 0.1,
    "bands": "narrow_h",
    "effects": {"segment_piston": {"piston_nm": PISTON_NM.tolist()}},
}
SPEC = {
    "simulation": "segments",
    "instrument": "nirc2_narrow",
    "seed": 3,
    "ncpa": {"total_nm": 80, "modes": 30},
    "detector": {"e_per_adu": 4.0, "read_noise_e": 60.0},
    "diversity": {"source": "lens", "zernike": {6: -170.0}},
    "recordings": {"cube": CUBE},
}


@pytest.mark.long
def test_segments_out_of_step_are_named_with_their_pistons_and_nothing_else_is(tmp_path):
    simulated(tmp_path / "sky", SPEC)
    run = tmp_path / "run"
    told = ["--set", "instrument=nirc2_narrow", "--input", f"cube={tmp_path / 'sky' / 'data' / 'cube'}"]
    ran = CliRunner().invoke(cli, ["run", "recipes/diagnose_bench.yaml", *told, "--output", str(run)])
    assert ran.exit_code == 0, ran.output
    found = json.loads((run / "results.json").read_text())["stages"]["diagnose"]
    assert (found["verdict"], found["grade"]) == ("effect", "complete")
    (step,) = found["steps"]
    assert step["effect"] == "segment_piston"
    error = np.array(step["parameters"]["piston_nm"]) - (PISTON_NM - PISTON_NM.mean())
    pulls = (error - error.mean()) / step["sigma"]["piston_nm"]  # piston of all does nothing
    # Tip, tilt and the lowest modes of the segments are those of the NCPAs, which have a prior.
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.5
