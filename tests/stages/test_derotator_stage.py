"""Stages `calibrate` with ``each`` and `derotator` on cubes made with the pipeline's own model. Truth: what
was put in, and the estimate of a cube reduced alone."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import series_bench as bench

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.stages import derotator as derotator
from irlos_pipe.stages.calibrate import stage as calibrate
from irlos_pipe.stages.derotator import PartRow

ANGLES = (0.0, 40.0, 110.0, 160.0)
EACH = {"input": "cube", "each": True, "highest_noll": 15, "prior_scale": None}


@pytest.fixture(scope="module")
def recordings():
    return [bench.recording(f"at_{angle:.0f}", angle, seed) for seed, angle in enumerate(ANGLES)]


@pytest.fixture(scope="module")
def calibrated(recordings):
    products = {"ingest": bench.ingest_product(recordings)}
    output, product = bench.run_stage(calibrate, products, **EACH)
    return output, products | {"calibrate": product}


@pytest.fixture(scope="module")
def split(calibrated):
    return bench.run_stage(derotator, calibrated[1])[0]


def error_nm(part: PartRow, true_nm: dict[int, float]) -> float:
    return float(np.linalg.norm([value - true_nm[noll] for noll, value in part.zernike_nm.items()]))


@pytest.mark.slow
def test_every_cube_gets_the_estimate_it_would_get_alone(recordings, calibrated):
    alone, _ = bench.run_stage(
        calibrate, {"ingest": bench.ingest_product(recordings[1:2])}, **EACH | {"each": False}
    )
    cube = calibrated[0].results.cubes[1]
    assert (cube.name, cube.derotator_angle_deg) == ("at_40", 40.0)
    assert cube.zernike_nm == alone.results.zernike_nm
    assert np.array_equal(
        calibrated[0].arrays["cubes/at_40/frames_nm"].value, alone.arrays["frames_nm"].value
    )


@pytest.mark.slow
def test_the_contracts_keys_hold_the_mean_over_the_cubes(calibrated):
    results = calibrated[0].results
    for noll, value in results.zernike_nm.items():
        cubes = [cube.zernike_nm[noll] for cube in results.cubes]
        errors = [cube.sigma_nm[noll] for cube in results.cubes]
        assert value == pytest.approx(np.mean(cubes))
        assert results.sigma_nm[noll] == pytest.approx(np.linalg.norm(errors) / len(errors))
    assert results.frames == len(ANGLES) * bench.FRAMES
    assert results.status == {"converged": len(ANGLES)}
    names = {check.name for check in calibrated[0].checks}
    assert {f"at_{angle:.0f}: converged fits" for angle in ANGLES} <= names


@pytest.mark.slow
def test_a_cube_without_a_used_frame_is_left_out_and_reported(recordings):
    poor = bench.recording("poor", 70.0, seed=9, used=0)
    products = {"ingest": bench.ingest_product([recordings[0], poor])}
    output, _ = bench.run_stage(calibrate, products, **EACH)
    assert [cube.name for cube in output.results.cubes] == ["at_0"]
    assert output.failures == ["poor: no used frame is left to calibrate with"]
    with pytest.raises(InputDataError, match="poor: no used frame"):
        bench.run_stage(calibrate, {"ingest": bench.ingest_product([poor])}, **EACH)


@pytest.mark.slow
def test_both_parts_are_found_within_their_errors(split):
    parts = split.results.parts
    for name, true_nm in (("rotating", bench.ROTATING_NM), ("fixed", bench.FIXED_NM)):
        assert error_nm(parts[name], true_nm) < 2 * parts[name].noise_nm < 2
    assert set(parts["unsplit"].zernike_nm) == {4, 11}
    assert parts["unsplit"].zernike_nm[4] == pytest.approx(50, abs=1)
    assert 0.5 < split.results.chi2_nu < 1.7
    assert split.results.sense == "clockwise"
    assert all(check.passed for check in split.checks)


@pytest.mark.slow
def test_a_wrong_sense_fails_the_quality_control(calibrated):
    output, _ = bench.run_stage(derotator, calibrated[1], sense="anticlockwise")
    assert [check.passed for check in output.checks] == [False]
    assert output.results.delta_chi2 < -1000


@pytest.mark.slow
def test_the_angle_of_a_k_mirror_counts_twice(recordings):
    halved = [
        replace(one, acquisition=replace(one.acquisition, derotator_angle_deg=angle / 2))
        for angle, one in zip(ANGLES, recordings, strict=True)
    ]
    products = {"ingest": bench.ingest_product(halved)}
    products["calibrate"] = bench.run_stage(calibrate, products, **EACH)[1]
    output, _ = bench.run_stage(derotator, products, turn_per_degree=2.0)
    assert error_nm(output.results.parts["rotating"], bench.ROTATING_NM) < 2
