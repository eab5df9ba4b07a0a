"""NCPAs corrected by a deformable mirror.

Truth: analysis of a linear loop, of turned and of shifted Zernike polynomials; the simulator's wavefronts.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.conventions.modes import CORRECTED_NOLLS
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.mirror_loop import experiment, stage
from irlos_pipe.paper.mirror_loop.experiment import (
    LOOPS,
    PARTS,
    SERIES,
    Loop,
    MirrorErrors,
    MirrorSample,
    close,
)
from irlos_pipe.paper.mirror_loop.section import section
from irlos_pipe.paper.mirror_loop.told import Judge, diversity_error_nm, further, told
from irlos_pipe.simulate.exposure import telescope_of

ERRORS = MirrorErrors(gain=0.9, shift=0.02, turn_deg=2.0)
SAMPLE = MirrorSample("test", (3, 0), cases.FACILITY, 150.0, 12, 2, 4, 0.5, 7.0, (0.25, 1.0), ERRORS)
JUDGE = Judge(telescope_of(SAMPLE.scene()))
ALIGNED = SAMPLE.mirror(0.25, MirrorErrors())


def sizes_nm(mirror, ncpa_nm, corrections=3):
    """Root of the sum of squares of Noll 4–30 before the first correction and after each."""
    states = told(JUDGE, mirror, JUDGE.telescope.opd_nm(ncpa_nm), 0.0, corrections)
    found = [JUDGE.coefficients_nm(state) for state in states]
    return np.array([np.linalg.norm([one[noll] for noll in CORRECTED_NOLLS]) for one in found])


@pytest.mark.parametrize("gain", [0.7, 1.2])
def test_a_gain_leaves_its_distance_from_one_to_the_power_of_the_corrections(gain):
    left_nm = sizes_nm(replace(ALIGNED, gain=gain), {4: 150.0, 6: -50.0, 11: 20.0})
    assert left_nm / left_nm[0] == pytest.approx(abs(1 - gain) ** np.arange(4), rel=0.03)


def test_a_turn_leaves_the_chord_of_its_angle_to_the_power_of_the_corrections():
    # On modes of angular order m a turn by α is a factor exp(i m α): |1 − exp(i m α)| = 2 sin(m α / 2).
    left_nm = sizes_nm(replace(ALIGNED, turn_deg=10.0), {6: 100.0})
    assert left_nm / 100 == pytest.approx((2 * np.sin(np.deg2rad(10.0))) ** np.arange(4), rel=0.03, abs=0.003)


def test_a_shift_of_coma_leaves_defocus_and_astigmatism_that_the_next_correction_takes():
    # ∂Z8/∂x = √24 Z4 + √12 Z6 − const.: 6 s of it in radii s of the shift; theirs are tilts only.
    shift = 0.02
    shifted = replace(ALIGNED, shift_m=(shift * ALIGNED.actuators.diameter_m / 2, 0.0))
    left_nm = sizes_nm(shifted, {8: 100.0})
    assert left_nm[1] == pytest.approx(100 * 6 * shift, rel=0.05)
    assert left_nm[2] < 0.02 * left_nm[1] + 0.2


def test_tip_and_tilt_are_not_corrected():
    assert further({4: 1.0}, {2: 9.0, 3: 9.0, 4: 3.0}) == {
        noll: -2.0 if noll == 4 else 0.0 for noll in CORRECTED_NOLLS
    }
    opd_nm = JUDGE.telescope.opd_nm({2: 80.0, 5: 30.0, 40: 10.0})
    still = JUDGE.left(JUDGE.telescope.opd_nm({5: 30.0, 40: 10.0}))
    assert vars(JUDGE.left(opd_nm)) == pytest.approx(vars(still))
    assert still.modes_nm == pytest.approx(30.0, rel=0.05)
    assert still.beyond_nm == pytest.approx(10.0, rel=0.1)
    assert still.all_nm == pytest.approx(np.hypot(still.modes_nm, still.beyond_nm), rel=0.02)


def test_a_diversity_made_with_a_gain_is_wrong_by_its_distance_from_one():
    error_nm = diversity_error_nm(
        JUDGE.telescope, replace(ALIGNED, gain=0.9, offsets_nm={4: 99.0}), {6: 170.0}
    )
    assert JUDGE.coefficients_nm(error_nm)[6] == pytest.approx(-17.0, rel=0.03)


class TrueCube:
    """A cube whose calibration is the true wavefront beyond the diversity as declared."""

    def __init__(self, scene):
        self._scene = scene

    of = classmethod(lambda cls, scene: cls(scene))

    def calibrated(self, variant):
        telescope = JUDGE.telescope
        opd_nm = telescope.opd_nm(self._scene.ncpa_nm) + self._scene.mirror.opd_nm(telescope)
        nolls, values = zip(*JUDGE.coefficients_nm(opd_nm).items(), strict=True)
        return SimpleNamespace(nolls=nolls, zernike_nm=np.array(values), sigma_nm=np.ones(len(nolls)))


@pytest.mark.parametrize("diversity", ["exact", "mirror"])
def test_a_loop_with_true_estimates_is_the_mirror_that_is_told_the_truth(monkeypatch, diversity):
    monkeypatch.setattr(experiment, "ObservedCube", TrueCube)
    monkeypatch.setattr(experiment, "star_image", lambda *told: (None, 0.5))
    monkeypatch.setattr(experiment, "predicted_strehl", lambda cube, calibration: 0.6)
    found = experiment._Bench(SAMPLE).closed(Loop(DEFAULT, diversity))
    real = SAMPLE.mirror(0.25, ERRORS)
    scene = SAMPLE.scene()
    unseen_nm = 0.0
    if diversity == "mirror":
        unseen_nm = diversity_error_nm(JUDGE.telescope, real, scene.diversity_nm)
    done = found["corrections"]
    states = told(JUDGE, real, JUDGE.telescope.opd_nm(scene.ncpa_nm), unseen_nm, done)
    expected = [JUDGE.left(state).modes_nm for state in states]
    assert found["modes_nm"][: done + 1] == pytest.approx(expected, abs=1e-6)
    assert np.isnan(found["modes_nm"][done + 1 :]).all()
    assert found["estimate/modes_nm"] == pytest.approx(0.0, abs=1e-6)
    # The loop makes the cube flat, and so the star bent by the error of the diversity.
    assert found["diversity/modes_nm"] == pytest.approx(17.0 if diversity == "mirror" else 0.0, rel=0.3)


@pytest.mark.long
def test_a_calibrated_loop_takes_a_bias_out():
    found = close(replace(SAMPLE, corrections=2, frames=20))
    name = LOOPS[0].name
    assert found[f"{name}/modes_nm"][0] > 150
    assert found[f"{name}/modes_nm"][2] < 0.15 * found[f"{name}/modes_nm"][0]
    assert found[f"{name}/strehl"][0] < found[f"{name}/strehl"][2] < found["ideal"] + 0.02


def series_of_estimates(sample: MirrorSample, corrections: int) -> np.ndarray:
    """Halved by every correction, but for the last where there are fewer than six."""
    seen_nm = 0.5 ** np.arange(sample.corrections + 1.0)
    seen_nm[corrections] = seen_nm[corrections - 1] if corrections < 6 else seen_nm[corrections]
    seen_nm[corrections + 1 :] = np.nan
    return seen_nm


@pytest.mark.parametrize(
    ("seen_nm", "falls"),
    [([9], True), ([9, 8, np.nan], True), ([90, 80], True), ([90, 82], False), ([9, 2, 3, np.nan], False)],
)
def test_an_estimate_improves_where_it_is_a_tenth_below_the_one_before(seen_nm, falls):
    assert experiment.improves(seen_nm) is falls


def numbers(sample: MirrorSample, left_nm: float, corrections: int) -> dict:
    series = np.full(sample.corrections + 1, np.nan)
    series[: corrections + 1] = np.linspace(200.0, left_nm, corrections + 1)
    found = {"ideal": 0.7}
    for loop in LOOPS:
        found |= {f"{loop.name}/{name}": series for name in SERIES}
        found[f"{loop.name}/seen_nm"] = series_of_estimates(sample, corrections)
        found |= {f"{loop.name}/corrections": corrections, f"{loop.name}/predicted": 0.6}
        for rank, part in enumerate(PARTS):
            found |= {f"{loop.name}/{part}/modes_nm": rank, f"{loop.name}/{part}/beyond_nm": 2.0 * rank}
    for pitch_m in sample.pitches_m:
        for error in sample.errors.alone():
            key = f"alone/{pitch_m:g}/{error}"
            found |= {f"{key}/modes_nm": np.ones(7), f"{key}/beyond_nm": np.arange(7.0)}
    return found


@pytest.mark.parametrize(
    ("left_nm", "corrections", "kept"),
    [(6.0, 3, [True] * 6), (12.0, 3, [True] * 4 + [False] * 2), (6.0, 6, [False] * 4 + [True] * 2)],
)
def test_the_default_is_asked_to_end_by_itself_and_low(monkeypatch, left_nm, corrections, kept):
    config = stage.Config(samples=2, biases_nm=(0.0, 200.0))
    output = run_stage(monkeypatch, stage, config, lambda sample: numbers(sample, left_nm, corrections))
    assert [check.passed for check in output.checks] == kept
    row = output.results.rows[0]
    assert [state.corrections for state in row.states] == list(range(corrections + 1))
    assert (row.end_nm.median, row.before_nm.median, row.limit) == (left_nm, 200.0, "estimate")
    assert [one.actuators for one in output.results.alone][::6] == [1160, 80]
    assert output.results.alone[0].beyond_nm == 6.0
    figure, table, parts, alone = section_of(output, "mirror_loop", section).blocks
    assert table.marks.count("good" if left_nm < 10 else "bad") == 2
    assert len(parts.rows) == 6 and len(alone.rows) == 12
    assert "bias 200 nm" in figure.svg
