"""Typed results. Truth: the JSON that the contract states, written and read back."""

import json
import math

import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import read_run_results, results_of
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import IngestResults
from irlos_pipe.stages.lift.stage import LiftResults, Twin


def test_json_has_the_keys_that_were_set_and_null_for_nan():
    results = LiftResults(modes=[2, 4], twin=Twin(name="a", twin_nm=math.nan))
    assert results.as_json() == {"modes": [2, 4], "twin": {"name": "a", "twin_nm": None}}


def test_null_and_an_absent_key_are_nan_when_read():
    row = results_of(IngestResults, Product("ingest", {}, {"inputs": [{"name": "a", "mag_j": None}]})).inputs[
        0
    ]
    assert math.isnan(row.mag_j) and math.isnan(row.flux_e)
    assert row.frames == 0 and row.reasons == {}


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
