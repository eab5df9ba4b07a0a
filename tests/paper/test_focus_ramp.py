"""Focus ramps with and without calibrated NCPAs.

Truth: the simulator, which shares no optics with LIFT's model; analysis of made-up estimates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, true_modes_nm
from irlos_pipe.paper.focus_ramp import stage
from irlos_pipe.paper.focus_ramp.experiment import (
    RampSample,
    estimate,
    ramp_errors,
    scenes_of,
)
from irlos_pipe.paper.focus_ramp.section import section as focus_ramp_section
from irlos_pipe.simulate.exposure import expose

SAMPLE = RampSample(
    "test", (31, 0), cases.FACILITY, (-200.0, 0.0, 200.0), 1, 40, ("none_3", "default_3"), 0.35, 7.0, 12.0
)


@pytest.fixture(scope="module")
def found():
    return estimate(SAMPLE)


@pytest.mark.slow
def test_calibrated_ncpas_bring_the_error_down_to_a_few_nanometres(found):
    assert ramp_errors(found, "default_3").true_rms_nm < 10
    assert ramp_errors(found, "default_3").true_rms_nm < 0.5 * ramp_errors(found, "none_3").true_rms_nm


@pytest.mark.slow
def test_the_ncpas_given_to_lift_count_as_estimated(found):
    given = found["default_3/modes_nm"][:, 2] - found["default_3/defocus_nm"]
    assert given == pytest.approx(np.full(3, scenes_of(SAMPLE)[0].ncpa_nm[4]), abs=15)
    assert np.array_equal(found["none_3/modes_nm"][:, 2], found["none_3/defocus_nm"])


def test_cube_and_ramp_share_their_ncpas_and_nothing_else():
    cube, ramp = scenes_of(SAMPLE)
    assert cube.ncpa_nm == ramp.ncpa_nm
    assert cube.seed != ramp.seed
    assert (len(cube.bands), len(ramp.bands)) == (1, 2)


@pytest.mark.slow
def test_the_true_modes_of_a_still_sky_are_ncpas_plus_introduced_defocus():
    ramp = replace(scenes_of(SAMPLE)[1], sky=None, motion=None)
    true = true_modes_nm(ramp, expose(ramp))
    ncpa = [ramp.ncpa_nm[noll] for noll in range(2, 12)]
    expected = np.array(ncpa) + np.outer(SAMPLE.offsets_nm, np.arange(2, 12) == 4)
    # Modes above Noll 31 leak a little into a least-squares fit over an obscured pupil.
    assert np.abs(true - expected).max() < 3


def test_errors_are_against_the_introduced_and_against_the_true_defocus():
    introduced = np.array([-100.0, 0.0, 100.0])
    made = {
        "introduced_nm": introduced,
        "true_nm": introduced[:, None] + np.full((3, 10), 20.0),
        "default_3/defocus_nm": 1.1 * introduced + 5,
        "default_3/modes_nm": np.tile((1.1 * introduced + 5 + 17)[:, None], 3),
        "default_3/converged": np.array([True, True, False]),
    }
    errors = ramp_errors(made, "default_3")
    assert (errors.slope, errors.offset_nm) == pytest.approx((1.1, 5.0))
    assert errors.rms_nm == pytest.approx(np.sqrt((25 + 225 + 25) / 3))
    assert errors.true_rms_nm == pytest.approx(np.sqrt((64 + 4 + 144) / 3))
    assert errors.converged == pytest.approx(2 / 3)


def test_the_published_variants_have_no_residual_in_their_model_and_the_default_has():
    assert all((variant.halo == "off") == (key.startswith("published") or key in ("none_3", "none_9"))
               for key, variant in LIFT_VARIANTS.items())  # fmt: skip


@pytest.mark.slow
def test_the_stage_reports_medians_over_samples_and_the_section_draws_the_first(found, monkeypatch):
    config = stage.Config(samples=3, ways=SAMPLE.variants, offsets=3)
    output = run_stage(monkeypatch, stage, config, lambda sample: found)
    rows = {row.key: row for row in output.results.ways}
    assert rows["default_3"].rms_nm.median == pytest.approx(ramp_errors(found, "default_3").rms_nm)
    assert output.arrays["default_3/rms_nm"].value.shape == (3,)
    errors, table = section_of(output, "focus_ramp", focus_ramp_section).blocks
    assert errors.title == "Error of every ramp"
    assert list(table.marks) == ["", "good"]


@pytest.mark.slow
def test_nine_modes_are_drawn_against_the_true_wavefront(found, monkeypatch):
    nine = {"default_9/modes_nm": np.repeat(found["true_nm"][:, :1], 9, axis=1)} | {
        f"default_9/{name}": found[f"default_3/{name}"] for name in ("defocus_nm", "converged")
    }
    config = stage.Config(samples=1, ways=("default_9",), offsets=3)
    output = run_stage(monkeypatch, stage, config, lambda sample: found | nine)
    modes, *_ = section_of(output, "focus_ramp", focus_ramp_section).blocks
    assert "11 spherical" in modes.svg
    assert "tilt" not in modes.svg


def test_samples_differ_in_nothing_but_seed_and_name(monkeypatch):
    seen = []
    config = stage.Config(samples=2, ways=("none_3",), offsets=5, reach_nm=100.0)
    with pytest.raises(KeyError):
        run_stage(monkeypatch, stage, config, lambda sample: seen.append(sample) or {})
    assert seen[0].offsets_nm == (-100.0, -50.0, 0.0, 50.0, 100.0)
    assert replace(seen[0], seed=seen[1].seed, name=seen[1].name) == seen[1]
    assert seen[0].seed != seen[1].seed
