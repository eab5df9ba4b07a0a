"""Stages `calibrate` with ``each`` and `derotator` on cubes made with the pipeline's own model. Truth: what
was put in, and the estimate of a cube reduced alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import series_bench as bench
from helpers.sparta_files import TWO_BY_TWO, quadrants, write_muse

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import LensletArray, apart
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.pipeline import Resources, run_recipe
from irlos_pipe.recipe import load_recipe
from irlos_pipe.stages import derotator as derotator
from irlos_pipe.stages import modes as modes
from irlos_pipe.stages.calibrate import stage as calibrate
from irlos_pipe.stages.derotator import PartRow

pytestmark = pytest.mark.slow
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


def error_nm(part: PartRow, true_nm: dict[int, float]) -> float:
    return float(np.linalg.norm([value - true_nm[noll] for noll, value in part.zernike_nm.items()]))


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


def test_the_cause_is_that_of_the_cube_that_does_not_fit(recordings):
    """One of two cubes has other pixels than declared; a method by frames says that there are none."""
    good, bad = recordings[:2]
    declared = replace(bad.acquisition, pixel_scale_mas=bad.acquisition.pixel_scale_mas * 1.03)
    products = {"ingest": bench.ingest_product([good, replace(bad, acquisition=declared)])}
    results = bench.run_stage(calibrate, products, **EACH)[0].results
    first = results.causes[0]
    assert first.name == "plate_scale" and first.says.startswith("at_40: ") and not results.no_causes
    assert first.value == pytest.approx(bad.acquisition.pixel_scale_mas, rel=0.005)
    per_frame = bench.run_stage(calibrate, products, **EACH | {"method": "dip_avg"})[0]
    assert not all(check.passed for check in per_frame.checks)
    assert not per_frame.results.causes and "mean image" in per_frame.results.no_causes


def test_few_frames_blame_what_many_blame():
    """Few frames are weighted by what the model misfits; a false cause would explain any misfit then."""
    few = bench.recording("few", 0.0, 5, frames=12)
    declared = replace(few.acquisition, pixel_scale_mas=few.acquisition.pixel_scale_mas * 1.03)
    products = {"ingest": bench.ingest_product([replace(few, acquisition=declared)])}
    causes = bench.run_stage(calibrate, products, **EACH | {"each": False})[0].results.causes
    assert causes[0].name == "plate_scale" and causes[0].explains > 0.9
    assert all(one.name == "plate_scale" or one.explains < 0.8 for one in causes)


def test_the_contracts_keys_hold_the_mean_over_the_cubes(calibrated):
    results = calibrated[0].results
    for noll, value in results.zernike_nm.items():
        cubes = [cube.zernike_nm[noll] for cube in results.cubes]
        errors = [cube.sigma_nm[noll] for cube in results.cubes]
        assert value == pytest.approx(np.mean(cubes))
        own, scatter = np.linalg.norm(errors) / len(errors), np.std(cubes, ddof=1) / len(cubes) ** 0.5
        expected = np.hypot(own, scatter) if noll > 3 else own  # shapes turn with the derotator
        assert results.sigma_nm[noll] == pytest.approx(expected)
    assert results.frames == len(ANGLES) * bench.FRAMES
    assert results.status == {"converged": len(ANGLES)}
    names = {check.name for check in calibrated[0].checks}
    assert {f"at_{angle:.0f}: converged fits" for angle in ANGLES} <= names


def test_a_cube_without_a_used_frame_is_left_out_and_reported(recordings):
    poor = bench.recording("poor", 70.0, seed=9, used=0)
    products = {"ingest": bench.ingest_product([recordings[0], poor])}
    output, _ = bench.run_stage(calibrate, products, **EACH)
    assert [cube.name for cube in output.results.cubes] == ["at_0"]
    assert output.failures == ["poor: no used frame is left to calibrate with"]
    with pytest.raises(InputDataError, match="poor: no used frame"):
        bench.run_stage(calibrate, {"ingest": bench.ingest_product([poor])}, **EACH)


def test_both_parts_are_found_within_their_errors(calibrated):
    split = bench.run_stage(derotator, calibrated[1])[0]
    parts = split.results.parts
    for name, true_nm in (("rotating", bench.ROTATING_NM), ("fixed", bench.FIXED_NM)):
        assert error_nm(parts[name], true_nm) < 2 * parts[name].noise_nm < 2
    assert set(parts["unsplit"].zernike_nm) == {4, 11}
    assert parts["unsplit"].zernike_nm[4] == pytest.approx(50, abs=1)
    assert 0.5 < split.results.chi2_nu < 1.7
    assert split.results.sense == "clockwise"
    assert all(check.passed for check in split.checks)


def test_a_wrong_sense_fails_the_quality_control(calibrated):
    output, _ = bench.run_stage(derotator, calibrated[1], sense="anticlockwise")
    assert [check.passed for check in output.checks] == [False]
    assert output.results.delta_chi2 < -1000


def test_the_angle_of_a_k_mirror_counts_twice(recordings):
    halved = [
        replace(one, acquisition=replace(one.acquisition, derotator_angle_deg=angle / 2))
        for angle, one in zip(ANGLES, recordings, strict=True)
    ]
    products = {"ingest": bench.ingest_product(halved)}
    products["calibrate"] = bench.run_stage(calibrate, products, **EACH)[1]
    output, _ = bench.run_stage(derotator, products, turn_per_degree=2.0)
    assert error_nm(output.results.parts["rotating"], bench.ROTATING_NM) < 2


# A raw file of a 2x2 mode through ingest, calibrate and lift.
# Truth: the wavefront in the images of the light path itself, with Poisson noise; they share its assumptions.


TRUE_NM = {2: 15.0, 3: -10.0, 4: 70.0, 5: 25.0, 6: -30.0}
FRAMES, FLUX_E, E_PER_ADU = 10, 1e5, 9.8 / 68
SIDE_CAR = "spectrum: [{wavelength_nm: 1600}]\nmag_j: 9\nexposure_s: 0.1\nframe_rate_hz: 10\n"
RECIPE = """\
recipe: small
inputs: {{cube: "{path}", ramp: "{path}"}}
stages: [{stages}]
model: {{effects: [tip_tilt_jitter], pupil_samples: 64}}
{calibrate}
lift: {{input: cube, start: zero, compare: false}}
"""


def raw_file(folder):
    settings = PsfSettings(
        load_instrument("irlos").pupil, (36, 36), 78.0, ((1600.0, 1.0),), KnownWavefront(), 64, lenslets=2
    )
    model = LensletArray(settings.for_broad_images(), tuple(TRUE_NM), dtype=torch.float64)
    mean_e = FLUX_E * model.images(torch.tensor([[*TRUE_NM.values()]], dtype=torch.float64))
    rng = np.random.default_rng(5)
    noisy = rng.poisson(mean_e.clamp_min(0).repeat(FRAMES, 1, 1).numpy()) + rng.normal(0, 1, (FRAMES, 36, 36))
    adu = torch.as_tensor(np.rint(noisy / E_PER_ADU + 200))
    path = write_muse(folder / "m.fits", quadrants([part.numpy() for part in apart(adu)]), TWO_BY_TWO)
    (folder / "m.yaml").write_text(SIDE_CAR)
    return path


def run(folder, stages: str, *settings: str) -> dict:
    calibrate = "calibrate: {input: cube, highest_noll: 6}" if "calibrate" in stages else ""
    text = RECIPE.format(path=raw_file(folder), stages=stages, calibrate=calibrate)
    (folder / "r.yaml").write_text(text)
    run_recipe(load_recipe(folder / "r.yaml", settings), folder / "out", resources=Resources(report=False))
    return json.loads((folder / "out" / "results.json").read_text())["stages"]


def test_a_raw_file_gives_its_low_orders_what_it_determines_and_the_focus_of_every_frame(tmp_path):
    stages = run(tmp_path, "ingest, calibrate, lift")
    calibrate, lift = stages["calibrate"], stages["lift"]
    for noll, truth_nm in TRUE_NM.items():
        error_nm = calibrate["zernike_nm"][str(noll)] - truth_nm
        assert abs(error_nm) < 4 * calibrate["sigma_nm"][str(noll)] + 0.5
    lenslets = calibrate["lenslets"]
    assert {4, 5, 6} <= set(lenslets["determined"]) and lenslets["combinations"] >= 5
    assert lenslets["information"] == sorted(lenslets["information"], reverse=True)
    assert lenslets["centroids_nm"]["4"] == pytest.approx(TRUE_NM[4], rel=0.25)
    assert 0 < lenslets["bound_nm"]["4"] < 3
    assert len(lift["points"]) == FRAMES and lift["summary"]["slope"] is None
    errors_nm = np.array([point["zernike_nm"]["4"] for point in lift["points"]])  # beyond the calibrated
    assert np.abs(errors_nm).max() < 6 * np.median([point["sigma_photon_nm"] for point in lift["points"]])
