"""What the stage `diagnose` hands on: results as scripts read them, a model as recipes take it, a section."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from helpers.diagnose_cases import CASE, CONDITIONS, cube, diagnosis_of, with_companion
from helpers.result_schema import section_problems

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.product.product import Product
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose import diagnose_section
from irlos_pipe.stages.diagnose.output import (
    checks_of,
    diagnose_arrays,
    diagnose_results,
    model_yaml,
    quality_arrays,
    recipe_entry,
)
from irlos_pipe.stages.diagnose.results import ARRAYS, DiagnoseResults
from irlos_pipe.stages.model.recording_settings import pooled_frames
from irlos_pipe.stages.model.section import EffectEntry, ModelConfig


@pytest.fixture(scope="module")
def results() -> dict:
    return diagnose_results(diagnosis_of("companion"), {6: -170.0}).as_json()


@pytest.mark.slow
def test_limits_of_what_was_not_seen_have_public_names_and_no_positions(results):
    assert results["mdb"]["vibration"].keys() == {"sigma_mas"}
    assert results["mdb"]["pupil_misregistration"].keys() <= {"dx_m", "dy_m", "rotation_deg"}
    assert 0 < results["mdb"]["vibration"]["sigma_mas"] < 5


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


def section_of(kind: str):
    diagnosis = diagnosis_of(kind)
    results = diagnose_results(diagnosis, {6: -170.0}).as_json()
    arrays = diagnose_arrays(diagnosis) | quality_arrays(diagnosis.pictures, CONDITIONS.settings)
    product = Product("diagnose", arrays, results, config={"input": "cube"})
    return diagnose_section(RunData({}, "", "ok", "", "", {"diagnose": product}, []))


def every(blocks):
    """All blocks, those of stacks and views too."""
    for block in blocks:
        yield block
        yield from every(getattr(block, "blocks", ()))
        yield from every(one for some in getattr(block, "choices", {}).values() for one in some)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "companion"])
def test_the_section_begins_with_the_verdict_in_words_and_shows_both_models(kind):
    section, results = section_of(kind), diagnose_results(diagnosis_of(kind), {6: -170.0})
    first = dict(section.blocks[0].rows)
    assert first["grade"].startswith(results.grade)
    found = [f"{one.phrase} ({one.significance:.0f} σ)" for one in results.steps]
    assert [text for question, text in first.items() if question == "missing"] == found
    titles = {getattr(block, "title", "") for block in every(section.blocks)}
    both = {f"{what} {when}" for what in ("Predicted", "Residual") for when in ("before", "after")}
    assert {"Measured", "Radial profile", "OTF cuts", "Encircled energy"} <= titles
    assert (both if results.steps else {"Predicted", "Residual"}) <= titles


@pytest.mark.slow
def test_residuals_before_and_after_are_drawn_on_one_scale():
    """The tick labels of both colour bars agree although the residuals differ by an order of magnitude."""
    pictures = diagnosis_of("companion").pictures
    before, after = (np.abs(pictures.measured_e - one).max() for one in (pictures.before_e, pictures.after_e))
    assert before > 5 * after
    (views,) = (one for one in section_of("companion").blocks if getattr(one, "name", "") == "dia-left")
    assert [*views.choices] == ["σ log", "σ linear", "% log", "% linear"]
    for figures in views.choices.values():
        texts = [re.findall(r"<text[^>]*>([^<]*)", str(one.svg)) for one in figures]
        assert texts[0] == texts[1]


def test_a_recording_without_frames_is_refused_with_its_name():
    frames, good = cube(with_companion()).images_e[:0].numpy(), np.ones(CASE.window, bool)
    acquisition = Acquisition("psf", Detector(1.0, 1.0), ((1600.0, 1.0),), {}, 9.7)
    recording = Recording(
        "short",
        "cube",
        frames,
        np.ones(0, bool),
        np.full(0, ""),
        good,
        np.arange(0.0),
        np.arange(0),
        np.zeros(0),
        acquisition,
    )
    with pytest.raises(InputDataError, match="short: no used frame is left"):
        pooled_frames([recording], good, CONDITIONS.settings)


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


def test_results_and_arrays_are_those_of_the_reference(results):
    assert section_problems("diagnose", results) == []
    assert section_problems("diagnose", results | {"surprise": 1}) != []
    arrays = diagnose_arrays(diagnosis_of("companion"))
    assert {name: len(ARRAYS[name][1].split(",")) for name in arrays} == {
        name: one.value.ndim for name, one in arrays.items()
    }


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
