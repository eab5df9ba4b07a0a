"""Focus ramps with and without calibrated NCPAs.

Truth: the simulator, which shares no optics with LIFT's model; analysis of made-up estimates.
"""

import numpy as np
import pytest
from helpers.experiment_stage import drawn, run_on, sample, tables_of

from irlos_pipe.paper import focus_ramp
from irlos_pipe.paper.common.ramps import observe, ramp_scene

OFFSETS_NM = (-200.0, 0.0, 200.0)
SIZES = {"reach_nm": 200.0, "offsets": 3, "frames_per_offset": 1, "cube_frames": 40}
STAR = sample(focus_ramp, sizes=SIZES | {"ways": ("none_3", "default_3", "default_9")})


@pytest.mark.slow
def test_the_true_modes_of_a_still_sky_are_ncpas_plus_introduced_defocus():
    ramp = ramp_scene(STAR.cube(0.35, 40, 7.0), 12.0, OFFSETS_NM, sky=None, motion=None)
    true = observe(ramp, {}).true_nm
    ncpa = [ramp.ncpa_nm[noll] for noll in range(2, 12)]
    expected = np.array(ncpa) + np.outer(OFFSETS_NM, np.arange(2, 12) == 4)
    # Modes above Noll 31 leak a little into a least-squares fit over an obscured pupil.
    assert np.abs(true - expected).max() < 3


def test_errors_are_against_the_introduced_and_against_the_true_defocus():
    introduced = np.array([-100.0, 0.0, 100.0])
    true, estimated = introduced[:, None] + np.full((3, 10), 20.0), 1.1 * introduced + 5
    errors = focus_ramp.ramp_errors(introduced, true, estimated, estimated + 17)
    assert (errors["slope"], errors["offset_nm"]) == pytest.approx((1.1, 5.0))
    assert errors["rms_nm"] == pytest.approx(np.sqrt((25 + 225 + 25) / 3))
    assert errors["true_rms_nm"] == pytest.approx(np.sqrt((64 + 4 + 144) / 3))


@pytest.mark.slow
def test_calibrated_ncpas_bring_the_error_down_to_a_few_nanometres(monkeypatch):
    found = list(focus_ramp.rows(STAR))
    none, default, _ = found
    assert default["true_rms_nm"] < min(10, 0.5 * none["true_rms_nm"])
    output = run_on(monkeypatch, focus_ramp, lambda star: found, samples=3, ways=STAR.sizes.ways)
    assert tables_of(output)["ways"].set_index("key").rms_nm["default_3"] == pytest.approx(default["rms_nm"])
    modes, _, table = drawn(output, focus_ramp).blocks
    assert "11 spherical" in modes.svg and "tilt" not in modes.svg and len(table.rows) == 3
