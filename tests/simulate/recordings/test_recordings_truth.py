"""The truth of simulated recordings. Expected: the coefficients put in, and Zernikes turned by hand."""

from __future__ import annotations

import json

import pytest
from helpers.simulation_specs import CUBE, RAMP, simulated, spec_of, truth

from irlos_pipe.simulate.recordings.run import SimulationFolder


@pytest.mark.slow
def test_the_truth_is_the_wavefront_that_was_put_in(tmp_path):
    ncpa = {4: 30.0, 7: -20.0, 31: 10.0}
    effects = {
        "focus_stage_offset": {"nm": 25},
        "companion": {"flux_ratio": 0.1, "sep_mas": 90, "pa_deg": 0},
    }
    ramp = RAMP | {"effects": effects, "sampling": {"pupil_samples": 96}}
    simulated(tmp_path / "out", spec_of({"ramp": ramp}, ncpa={"zernike_nm": ncpa}))
    told = truth(tmp_path / "out", "ramp__offset_02")
    assert told["hidden"].keys() == effects.keys() and told["introduced_defocus_nm"] == 200
    assert {int(noll): nm for noll, nm in told["ncpa_nm"].items()} == ncpa
    mean = {int(noll): nm for noll, nm in told["mean_zernike_nm"].items()}
    expected = dict.fromkeys(range(2, 32), 0.0) | ncpa | {4: 30.0 + 200 + 25}
    assert mean == pytest.approx(expected, abs=1e-6)


def test_the_truth_of_a_derotator_series_turns_with_the_angle(tmp_path):
    series = {"turns": CUBE | {"role": "derotator", "angles_deg": [0, 45]}}
    fixed, turning = {"zernike_nm": {4: 10.0}}, {"zernike_nm": {6: 30.0}}
    simulated(tmp_path / "out", spec_of(series, ncpa=fixed, rotating=turning))
    # cos 2(theta - 45 deg) = sin 2 theta: vertical astigmatism, Noll 6, becomes oblique, Noll 5.
    expected = ({6: 30.0, 4: 10.0}, {5: 30.0, 4: 10.0})
    for index, zernike_nm in enumerate(expected):
        found = truth(tmp_path / "out", f"turns__angle_0{index}")
        for key in ("ncpa_nm", "mean_zernike_nm"):
            values = {int(noll): nm for noll, nm in found[key].items() if abs(nm) > 1e-6}
            assert values == pytest.approx(zernike_nm)


def test_a_truth_that_names_a_folder_elsewhere_removes_nothing_there(tmp_path):
    target = SimulationFolder(tmp_path / "sim")
    (tmp_path / "sim" / "truth").mkdir(parents=True)
    (tmp_path / "sim" / "data" / "mine").mkdir(parents=True)
    (tmp_path / "precious").mkdir()
    for name, told in (("x", "../../precious"), ("y", "mine"), ("z", ".")):
        forged = {"simulation": {"recording": {"name": told}}}
        (tmp_path / "sim" / "truth" / f"{name}.json").write_text(json.dumps(forged))
        target.remove(name)
    assert (tmp_path / "precious").is_dir()
    assert list((tmp_path / "sim" / "data").iterdir()) == []
    assert list((tmp_path / "sim" / "truth").iterdir()) == []
