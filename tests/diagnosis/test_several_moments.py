"""Recordings of several stars and nights: what they share, what each has of its own."""

import numpy as np
import pytest
import torch
from helpers.diagnose_frames import CONDITIONS, FLUX_E, NOLLS, OPTIONS, TRUE_NM, cube, frames, image, model
from helpers.light_path_derivatives import assert_gradient
from helpers.optics_cases import vector
from helpers.simulated_scenes import image as simulated

from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.scores import families
from irlos_pipe.diagnosis.sharing import sharing
from irlos_pipe.diagnosis.view import Exposures, Moments, View, placed
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import TipTiltJitter
from irlos_pipe.effects.colour import PlateScale
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames

DRIFT_NM = 8.0
FRACTION, JITTER_MAS = 0.01, 9.0
FIRST, SECOND = frozenset({0}), frozenset({1})


def exposures(taken: Frames, moment: int, star: str) -> Exposures:
    return Exposures(taken, CONDITIONS, moment=moment, name=f"night {moment + 1}", star=star)


def moments(stars: str = "AB") -> Moments:
    some = frames(image())
    return Moments.of([exposures(some, number, star) for number, star in enumerate(stars)])


def drifted(seed: int) -> dict[int, float]:
    """The common wavefront with another night's changes of every mode beyond pointing."""
    change = np.random.default_rng(seed).normal(0, DRIFT_NM, len(NOLLS))
    return {n: v + (float(d) if n > 3 else 0.0) for (n, v), d in zip(TRUE_NM.items(), change, strict=True)}


def two_nights() -> tuple[Fitter, Cube]:
    """One wrong scale in both nights, image motion in the second alone; images of the model itself."""
    first = image(drifted(1), PlateScale.under(CONDITIONS), [FRACTION])
    second = _with_both(drifted(2))
    both = Cube.of_all([cube(first, 1), cube(second, 2)])
    return Fitter([View(model(), CONDITIONS, number) for number in (0, 1)], both.training), both


def _with_both(modes_nm: dict[int, float]) -> np.ndarray:
    whole = ImageModel(model(), [PlateScale.under(CONDITIONS), TipTiltJitter()])
    values = torch.tensor(
        [{"plate_scale": FRACTION}.get(one.name, JITTER_MAS**2) for one in whole.effects.effects],
        dtype=torch.float64,
    )
    flux, none = torch.tensor([FLUX_E], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    return whole.predict(vector(modes_nm, NOLLS), flux, none, values)[0].numpy()


@pytest.fixture(scope="module")
def fitted():
    fitter, _ = two_nights()
    return fitter.fit([PlateScale.under(CONDITIONS), TipTiltJitter().only_in(SECOND)])


def test_gradients_with_own_effects_and_drifts_are_those_of_finite_differences(fitted):
    problem, x, first = fitted.problem, fitted.x.clone(), torch.arange(1)
    x[0, problem.drifts[0][3]] += 6.0
    x[0, problem.layout.effect_values.start] += 1e-3
    common, own = (fitted.columns_of(name)[0] for name in ("plate_scale", "tip_tilt_jitter"))
    drift, flux = problem.drifts[1][2], problem.size - 2
    gradient = problem.normal_equations(x, first)[1]
    steps = {4: 1e-3, drift: 1e-3, common: 1e-6, own: 1e-2, flux: 1.0}
    assert_gradient(lambda at: problem.objective(at, first), gradient, x, steps, rel=1e-3)


def test_what_both_nights_share_and_what_one_has_alone_are_fitted_as_they_are(fitted):
    assert fitted.values_of("plate_scale")[0] == pytest.approx(FRACTION, rel=0.02)
    assert np.sqrt(fitted.values_of("tip_tilt_jitter")[0]) == pytest.approx(JITTER_MAS, rel=0.05)
    wavefronts = [problem_x[0, 2 : len(NOLLS)].numpy() for _, problem_x in fitted.recordings]
    for seed, found in enumerate(wavefronts, start=1):
        true = np.array(list(drifted(seed).values()))[2:]
        assert np.sqrt(np.mean((found - true) ** 2)) < 1.0
    assert fitted.chi2 / fitted.problem.freedom < 1.15


def test_one_value_for_all_is_told_from_a_value_of_one_night(fitted):
    fitter, data = two_nights()
    scale = sharing(["plate_scale"], fitted, fitter, data, moments(), 5.0)
    motion = sharing(["tip_tilt_jitter"], fitted, fitter, data, moments(), 5.0)
    assert scale.finding == "common"
    assert [one.parameters["fraction"] for one in scale.values] == pytest.approx([FRACTION] * 2, rel=0.03)
    assert motion.finding == "differs"
    assert motion.held_out_z > 3
    assert [one.significance > 5 for one in motion.values] == [False, True]


def test_a_model_has_what_is_the_instruments_once_and_the_sky_for_every_moment():
    of_each = {number: [PlateScale.under(CONDITIONS), TipTiltJitter(), Companion()] for number in range(3)}
    found = placed(of_each, moments("AAB"))
    assert [(one.name, one.acts_in) for one in found] == [
        ("plate_scale", None),
        ("tip_tilt_jitter", {0}),
        ("tip_tilt_jitter", {1}),
        ("tip_tilt_jitter", {2}),
        ("companion", {0, 1}),
        ("companion", {2}),
    ]


@pytest.mark.parametrize(("stars", "ghost"), [("AB", {None}), ("AA", set())])
def test_a_ghost_is_looked_for_in_all_recordings_and_a_companion_at_each_star(stars, ghost):
    found, _ = families(moments(stars), [PlateScale.under(CONDITIONS), TipTiltJitter().only_in(FIRST)])
    places = {
        name: {where for family in found if family.effect.name == name for where in family.placements}
        for name in ("ghost", "companion", "plate_scale", "tip_tilt_jitter", "pupil_misregistration")
    }
    assert places == {
        "ghost": ghost,
        "companion": {FIRST, SECOND} if stars == "AB" else {None},
        "plate_scale": set(),  # the model has it
        "tip_tilt_jitter": {SECOND},  # the first has it
        "pupil_misregistration": {None, FIRST, SECOND},
    }


# -- whole diagnoses -----------------------------------------------------------------------------

GHOST = {"flux_ratio": 0.01, "sep_mas": 120.0, "pa_deg": 220.0, "defocus_nm": 80.0}
COMPANION = {"flux_ratio": 0.02, "sep_mas": 110.0, "pa_deg": 60.0}


def night(number: int, star: str, effects: dict) -> Exposures:
    """Frames of the simulator, which shares no optics with the model."""
    true = simulated(ncpa_nm=drifted(number + 5), window=CONDITIONS.settings.window, effects=effects)
    return exposures(frames(true * 1e6, number), number, star)


@pytest.mark.slow
@pytest.mark.long
def test_a_ghost_common_to_two_stars_and_a_companion_of_one_have_their_names():
    taken = [night(0, "A", {"ghost": GHOST, "companion": COMPANION}), night(1, "B", {"ghost": GHOST})]
    found = diagnose(taken, [], OPTIONS)
    steps = {step.name: step for step in found.steps}
    assert set(steps) == {"ghost", "companion"}
    assert steps["ghost"].effect.acts_in is None
    assert steps["companion"].effect.acts_in == FIRST
    assert steps["ghost"].public["flux_ratio"] == pytest.approx(0.01, rel=0.05)
    assert steps["ghost"].public["defocus_nm"] == pytest.approx(80.0, abs=15.0)
    assert steps["companion"].public["flux_ratio"] == pytest.approx(0.02, rel=0.05)


@pytest.mark.slow
def test_nights_that_differ_in_their_wavefront_alone_have_no_names():
    taken = [night(number, "A", {}) for number in (0, 1)]
    found = diagnose(taken, [], OPTIONS)
    assert found.verdict == "none"
    assert all(0.3 * DRIFT_NM < one.ncpa_change_nm < 1.5 * DRIFT_NM for one in found.together.stars)
