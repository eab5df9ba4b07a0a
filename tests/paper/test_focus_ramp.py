"""Focus ramps with and without calibrated NCPAs.

Truth: the simulator, which shares no optics with LIFT's model; analysis of made-up estimates.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.experiment_stage import run_on, sample, section_of, tables_of

from irlos_pipe.paper import focus_ramp
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, ramp_scene, true_modes_nm
from irlos_pipe.simulate.exposure import expose

OFFSETS_NM = (-200.0, 0.0, 200.0)
SIZES = {"reach_nm": 200.0, "offsets": 3, "frames_per_offset": 1, "cube_frames": 40}
STAR = sample(focus_ramp, sizes=SIZES | {"ways": ("none_3", "default_3", "default_9")})


@pytest.fixture(scope="module")
def found():
    return list(focus_ramp.rows(STAR))


@pytest.mark.slow
def test_calibrated_ncpas_bring_the_error_down_to_a_few_nanometres(found):
    none, default, _ = found
    assert default["true_rms_nm"] < min(10, 0.5 * none["true_rms_nm"])


def test_cube_and_ramp_share_their_ncpas_and_nothing_else():
    cube = STAR.cube(0.35, 40, 7.0)
    ramp = ramp_scene(cube, 12.0, OFFSETS_NM)
    assert cube.ncpa_nm == ramp.ncpa_nm
    assert cube.seed != ramp.seed
    assert (len(cube.bands), len(ramp.bands)) == (1, 2)


@pytest.mark.slow
def test_the_true_modes_of_a_still_sky_are_ncpas_plus_introduced_defocus():
    ramp = replace(ramp_scene(STAR.cube(0.35, 40, 7.0), 12.0, OFFSETS_NM), sky=None, motion=None)
    true = true_modes_nm(ramp, expose(ramp))
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


def test_the_published_variants_have_no_residual_in_their_model_and_the_default_has():
    assert all((variant.halo == "off") == (key.startswith("published") or key in ("none_3", "none_9"))
               for key, variant in LIFT_VARIANTS.items())  # fmt: skip


@pytest.mark.slow
def test_medians_are_over_the_ramps_and_nine_modes_are_drawn_against_the_true_wavefront(found, monkeypatch):
    output = run_on(monkeypatch, focus_ramp, lambda star: found, samples=3, ways=STAR.sizes.ways)
    ways = tables_of(output)["ways"].set_index("key")
    assert ways.rms_nm["default_3"] == pytest.approx(found[1]["rms_nm"])
    modes, errors, table = section_of(output, "focus_ramp", focus_ramp.EXPERIMENT.section).blocks
    assert "11 spherical" in modes.svg and "tilt" not in modes.svg
    assert errors.title == "Error of every ramp" and len(table.rows) == 3
