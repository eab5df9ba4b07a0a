"""Typed results. Truth: the JSON that the contract states, written and read back."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnosis.records import FineStructure
from irlos_pipe.product.product import Product, declared
from irlos_pipe.product.results import RunResults, read_run_results, results_of
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.diagnose.results import DiagnoseResults
from irlos_pipe.stages.ingest.results import IngestResults, RecordingRow
from irlos_pipe.stages.lift.results import LiftResults, Line
from irlos_pipe.stages.sensitivity import CurveRow


def test_json_has_the_keys_that_were_set_and_null_for_nan():
    results = LiftResults(modes=[2, 4], summary=Line(slope=1.0, offset_nm=math.nan))
    assert results.as_json() == {"modes": [2, 4], "summary": {"slope": 1.0, "offset_nm": None}}


def test_coefficients_are_by_number_in_memory_and_by_text_in_json():
    results = CalibrateResults(zernike_nm={2: 1.0, 10: -3.0})
    assert results.as_json() == {"zernike_nm": {"2": 1.0, "10": -3.0}}
    assert results_of(CalibrateResults, Product("calibrate", {}, results.as_json())) == results


def test_null_and_an_absent_key_are_nan_when_read():
    row = results_of(IngestResults, Product("ingest", {}, {"inputs": [{"name": "a", "mag_j": None}]})).inputs[
        0
    ]
    assert math.isnan(row.mag_j) and math.isnan(row.flux_e)
    assert row.frames == 0 and row.reasons == {}


def test_keys_of_a_newer_version_are_ignored():
    assert RecordingRow.model_validate({"name": "a", "unheard_of": 1}).name == "a"


def test_an_effects_number_is_found_by_name_and_nan_without_the_effect():
    results = results_of(CalibrateResults, made_run.calibrate())
    assert results.effect_number("tip_tilt_jitter", "sigma_mas") == 6.9
    assert math.isnan(results.effect_number("tip_tilt_jitter", "angle_deg"))
    assert math.isnan(results.effect_number("companion", "flux_ratio"))


def test_damaged_results_name_the_key():
    with pytest.raises(InputDataError, match=r"'lift': points\.0\.defocus_nm: .*number"):
        results_of(LiftResults, Product("lift", {}, {"points": [{"defocus_nm": "far"}]}))


def test_results_of_a_run_give_a_stages_section_as_its_model(tmp_path):
    path = tmp_path / "results.json"
    content = {"status": "ok", "recipe": "made", "stages": {"lift": made_run.lift().results}}
    path.write_text(json.dumps(content))
    run = read_run_results(path)
    assert (run.status, run.recipe, run.error) == ("ok", "made", "")
    assert run.of(LiftResults).summary.slope == 0.998
    assert run.of(CalibrateResults) == CalibrateResults()


@pytest.mark.parametrize("content", ["", "[]", "{", "[" * 100_000, '{"stages": 3}'])
def test_a_file_that_is_not_results_is_refused_with_its_name(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_text(content)
    with pytest.raises(InputDataError, match=r"results\.json: .*run the recipe again"):
        read_run_results(path)


def test_the_schema_keeps_its_name():
    content = {"schema": "irlos-results", "schema_version": 1, "recipe": "a", "status": "ok", "stages": {}}
    assert RunResults.model_validate(content).as_json() == content


def test_a_part_that_science_declares_is_written_and_read_like_the_others():
    results = DiagnoseResults(fine_structure=FineStructure(ratio=math.nan, significance=2.0))
    assert results.as_json() == {"fine_structure": {"ratio": None, "significance": 2.0}}
    content = {"fine_structure": {"ratio": None, "unheard_of": 1}}
    read = results_of(DiagnoseResults, Product("diagnose", {}, content)).fine_structure
    assert math.isnan(read.ratio) and read.significance == 0.0


def test_two_numbers_are_a_value_with_its_error_only_where_an_error_is_declared():
    table = {"noll": ("", "mode", "index"), "parts/<part>": ("nm ±", "mode", "part")}
    arrays = declared(table, {"noll": (2, 3), "parts/fixed": ([1.0, 2.0], [0.1, 0.2])}, "mean")
    assert arrays["noll"].value.tolist() == [2, 3] and arrays["noll"].error is None
    fixed = arrays["parts/fixed"]
    assert (fixed.unit, fixed.description, list(fixed.error)) == ("nm", "part; mean", [0.1, 0.2])
    with pytest.raises(KeyError):
        declared(table, {"nol": (2, 3)})


def test_a_part_takes_what_science_calls_by_the_names_of_its_fields_and_nothing_else():
    summary = SimpleNamespace(slope=1.0, offset_nm=-2.0, offsets_nm=np.zeros(3))
    assert Line.filled_from(summary, offset_nm=5.0).as_json() == {"slope": 1.0, "offset_nm": 5.0}
    curve = SimpleNamespace(mag_j=np.array([12.0, 13.0]), trials=4)
    assert CurveRow.filled_from(curve, modes=[4]).as_json() == {
        "modes": [4], "mag_j": [12.0, 13.0], "trials": 4,
    }  # fmt: skip
