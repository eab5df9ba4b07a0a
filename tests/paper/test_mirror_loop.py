"""NCPAs corrected by a deformable mirror.

Truth: analysis of a linear loop, of turned and of shifted Zernike polynomials; the simulator's wavefronts.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.experiment_stage import sample

from irlos_pipe.conventions.modes import CORRECTED_NOLLS
from irlos_pipe.paper import mirror_loop
from irlos_pipe.paper.mirror_loop import LOOPS, Bench, corrected, mirror_of
from irlos_pipe.simulate.mirror import Actuators, Mirror

pytestmark = pytest.mark.xdist_group("mirror_loop")  # its fixtures serve all tests

SIZES = {
    "frames": 12, "star_frames": 2, "corrections": 4, "pitches_m": (0.25,), "shift": 0.02, "turn_deg": 2.0
}  # fmt: skip
STAR = sample(mirror_loop, (3, 0), sizes=SIZES, bias_nm=150.0)
SCENE = mirror_loop.scene_of(STAR)
BENCH = Bench(SCENE, 2)
ALIGNED = Mirror(Actuators(STAR.facility.pupil.diameter_m, 0.25))


def sizes_nm(mirror, ncpa_nm, corrections=3):
    """Root of the sum of squares of Noll 4–30 before the first correction and after each."""
    bench = Bench(replace(SCENE, ncpa_nm=ncpa_nm), 2)
    found = [bench.coefficients_nm(state) for state in bench.told(mirror, corrections)]
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
    expected = {noll: -2.0 if noll == 4 else 0.0 for noll in CORRECTED_NOLLS}
    sent = corrected(replace(ALIGNED, offsets_nm={4: 1.0}), {2: 9.0, 3: 9.0, 4: 3.0})
    assert sent.offsets_nm == expected
    still = BENCH.of(BENCH.telescope.opd_nm({5: 30.0, 40: 10.0}))
    assert BENCH.of(BENCH.telescope.opd_nm({2: 80.0, 5: 30.0, 40: 10.0})) == pytest.approx(still)
    assert still["modes_nm"] == pytest.approx(30.0, rel=0.05)
    assert still["beyond_nm"] == pytest.approx(10.0, rel=0.1)
    assert still["all_nm"] == pytest.approx(np.hypot(still["modes_nm"], still["beyond_nm"]), rel=0.02)


class TrueCube:
    """A cube whose calibration is the true wavefront beyond the diversity as declared."""

    def __init__(self, scene):
        self._scene = scene

    of = classmethod(lambda cls, scene: cls(scene))

    def calibrated(self, variant):
        telescope = BENCH.telescope
        opd_nm = telescope.opd_nm(self._scene.ncpa_nm) + self._scene.mirror.opd_nm(telescope)
        nolls, values = zip(*BENCH.coefficients_nm(opd_nm).items(), strict=True)
        return SimpleNamespace(nolls=nolls, zernike_nm=np.array(values))


@pytest.fixture(scope="module")
def true_rows():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirror_loop, "ObservedCube", TrueCube)
        patch.setattr(mirror_loop, "star_image", lambda *told: (None, 0.7))
        patch.setattr(Bench, "strehl", lambda bench, mirror: 0.5)
        patch.setattr(mirror_loop, "predicted_strehl", lambda cube, calibration: 0.6)
        return list(mirror_loop.rows(STAR))


@pytest.mark.slow
@pytest.mark.parametrize("diversity", ["exact", "mirror"])
def test_a_loop_with_true_estimates_is_the_mirror_that_is_told_the_truth(true_rows, diversity):
    own = [row for row in true_rows if (row.get("method"), row.get("diversity")) == (LOOPS[0][0], diversity)]
    states = [row for row in own if row["what"] == "state"]
    real = mirror_of(STAR, 0.25)
    told = BENCH.told(real, len(states) - 1, BENCH.unseen_nm(real, diversity))
    assert [row["modes_nm"] for row in states] == pytest.approx(
        [BENCH.of(one)["modes_nm"] for one in told], abs=1e-6
    )
    assert [row["last"] for row in states] == [False] * (len(states) - 1) + [True]
    causes = {row["cause"]: row["modes_nm"] for row in own if row["what"] == "cause"}
    assert causes["estimate"] == pytest.approx(0.0, abs=1e-6)
    # The loop makes the cube flat, and so the star bent by the error of the diversity.
    assert causes["diversity"] == pytest.approx(17.0 if diversity == "mirror" else 0.0, rel=0.3)


@pytest.mark.long
def test_a_calibrated_loop_takes_a_bias_out():
    star = sample(mirror_loop, (3, 0), sizes=SIZES | {"corrections": 2, "frames": 20}, bias_nm=150.0)
    first, *_, last = [row for row in mirror_loop.rows(star) if row["what"] == "state"][:3]
    assert first["modes_nm"] > 150
    assert last["modes_nm"] < 0.15 * first["modes_nm"]
    assert first["strehl"] < last["strehl"]
