"""The capture range. Truth: the simulator, which shares no optics with LIFT's model; counting by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.paper.capture import stage
from irlos_pipe.paper.capture.experiment import CaptureSample, capture, simulate_ramp
from irlos_pipe.paper.capture.outcome import Estimates, success_per_bin
from irlos_pipe.paper.capture.results import Counts
from irlos_pipe.paper.capture.section import section as capture_section
from irlos_pipe.paper.common.ramps import STARTS

SAMPLE = CaptureSample("test", (20, 3), cases.FACILITY, 6, 800.0, 2.0, 12.0, 0.5, 15.0)


@pytest.fixture(scope="module")
def found():
    return capture(SAMPLE)


def estimates(found, start) -> Estimates:
    return Estimates(found["true_nm"], found[f"{start}/defocus_nm"], found[f"{start}/converged"])


# -- the experiment ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("start", ["scan", "default"])
def test_the_scan_and_the_default_find_every_defocus(found, start):
    assert estimates(found, start).captured.all()
    assert estimates(found, start).error_nm.max() < 20


@pytest.mark.slow
def test_a_start_from_zero_misses_large_defocus_only(found):
    zero = estimates(found, "zero")
    assert zero.within(350).captured.all()
    assert not zero.captured.all()


@pytest.mark.slow
def test_estimates_that_are_captured_agree_whatever_the_start(found):
    both = estimates(found, "zero").captured
    assert found["zero/defocus_nm"][both] == pytest.approx(found["scan/defocus_nm"][both], abs=1)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_frames(found):
    again = simulate_ramp(SAMPLE)
    assert np.array_equal(again.data.introduced_nm, found["true_nm"])


@pytest.mark.slow
def test_every_frame_has_its_own_sky_and_pointing():
    ramp = simulate_ramp(replace(SAMPLE, frames=6, reach_nm=1e-6, shift_px=3.0))
    assert np.std(ramp.data.introduced_nm) > 1  # what is left is the defocus of the sky
    bright = (ramp.data.images_e - 0.3 * ramp.data.images_e.amax((1, 2), keepdim=True)).clamp_min(0)
    columns = (bright.sum(1) @ torch.arange(64.0)) / bright.sum((1, 2))
    assert 0.5 < columns.std() < 3.0


@pytest.mark.slow
def test_h_alone_has_the_light_and_the_wavelength_of_h():
    both, alone = (simulate_ramp(replace(SAMPLE, frames=1, h_alone=h)) for h in (False, True))
    assert alone.scene.photons == pytest.approx(both.scene.photons / 2)
    assert [wavelength for wavelength, _ in alone.scene.spectrum(1)] == [1625.0]
    assert float(alone.data.images_e.sum() / both.data.images_e.sum()) == pytest.approx(0.5, rel=0.03)


@pytest.mark.slow
def test_the_ncpas_given_to_lift_err_as_asked():
    ramps = [
        simulate_ramp(replace(SAMPLE, seed=(seed,), frames=1, calibration_error_nm=20.0)) for seed in range(8)
    ]
    errors = [
        [value - ramp.scene.ncpa_nm.get(noll, 0.0) for noll, value in ramp.known_ncpa_nm.items() if noll > 3]
        for ramp in ramps
    ]
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) == pytest.approx(20, rel=0.12)


# -- counting ----------------------------------------------------------------------------------------

COUNTED = Estimates(
    np.array([-500.0, -300.0, 0.0, 100.0, 450.0, 700.0]),
    np.array([-495.0, 280.0, 3.0, 100.0, 300.0, 700.0]),
    np.array([True, True, True, True, False, True]),
)


def test_right_wrong_and_flagged_are_counted_apart():
    assert COUNTED.counts() == Counts(cases=6, captured=4, wrong=1, flagged=1)
    assert COUNTED.within(450).counts() == Counts(cases=4, captured=2, wrong=1, flagged=1)


def test_the_range_ends_with_the_smallest_defocus_that_was_missed():
    assert COUNTED.range_nm() == 300
    assert COUNTED.within(100).range_nm() == 100


def test_the_gap_lies_between_the_worst_right_and_the_best_wrong_estimate():
    assert COUNTED.gap_nm() == (5, 580)
    assert np.isnan(COUNTED.within(100).gap_nm()[1])


def test_the_error_is_that_of_the_captured():
    assert COUNTED.rms_nm() == pytest.approx(np.sqrt((25 + 9) / 4))


def test_success_is_counted_in_bins_of_true_defocus():
    captured, cases_per_bin = success_per_bin(COUNTED, np.array([-600.0, -200.0, 200.0, 800.0]))
    assert captured.tolist() == [1, 2, 1]
    assert cases_per_bin.tolist() == [2, 2, 2]


# -- stage and report --------------------------------------------------------------------------------


@pytest.fixture
def output(found, monkeypatch):
    config = stage.Config(ramps=2, h_ramps=1, frames=6, reach_nm=800.0, required_nm=800.0)
    return run_stage(monkeypatch, stage, config, lambda sample: found)


@pytest.mark.slow
def test_the_stage_reports_every_start_and_passes_when_the_default_misses_nothing(output):
    rows = {row.start: row for row in output.results.starts}
    assert tuple(rows) == STARTS
    assert rows["default"].all == Counts(cases=12, captured=12, wrong=0, flagged=0)
    assert sum(rows["default"].cases_per_bin) == 12
    assert output.checks[0].value == 0 and output.arrays["true_nm"].value.shape == (12,)


@pytest.mark.slow
def test_the_section_shows_starts_and_their_estimates(output):
    success, scatter, table, h_table = section_of(output, "capture", capture_section).blocks
    assert success.title == "Success against defocus"
    assert [figure.title for figure in scatter.blocks] == ["Where the iteration starts", "Where it ends"]
    assert table.marks[-1] == "good" and table.marks[0] == "bad"
    assert table.rows[-1][:4] == ("this pipeline's default", "12 of 12", "0", "0")
    assert h_table.rows[-1][:4] == ("this pipeline's default", "6 of 6", "0", "0")
