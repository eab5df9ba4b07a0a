"""A wavefront of another run as a start: the key `begin_near` of a recipe."""

from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from irlos_pipe.stages.diagnose.stage import Config

CALIBRATED = {"calibrate": {"zernike_nm": {"4": 1.0}, "all_zernike_nm": {"4": 1.5, "40": 2.0}}}
DIAGNOSED = {"diagnose": {"zernike_nm": {"before": {"5": 3.0}, "after": {"5": 4.0}}}}


def written(folder, stages):
    (folder / "results.json").write_text(json.dumps({"stages": stages}))
    return folder


@pytest.mark.parametrize(
    ("stages", "taken"),
    [
        (CALIBRATED, {4: 1.5, 40: 2.0}),
        (DIAGNOSED, {5: 4.0}),
        (CALIBRATED | DIAGNOSED, {5: 4.0}),
    ],
)
def test_a_run_gives_what_it_found(tmp_path, stages, taken):
    folder = written(tmp_path, stages)
    assert Config(begin_near=str(folder)).begin_near == taken
    assert Config(begin_near=str(folder / "results.json")).begin_near == taken


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("nowhere", "nowhere: No such file"),
        ({1: 5.0}, "greater than or equal to 2"),
        ({4: 1e5}, "less than or equal to 5000"),
    ],
)
def test_what_is_no_wavefront_is_refused(value, said):
    with pytest.raises(ValidationError, match=said):
        Config(begin_near=value)


@pytest.mark.parametrize("content", ["{", "[]", '{"stages": {"ingest": {}}}'])
def test_a_run_without_a_wavefront_is_refused(tmp_path, content):
    (tmp_path / "results.json").write_text(content)
    with pytest.raises(ValidationError, match=r"results\.json: .*; give a"):
        Config(begin_near=str(tmp_path))
