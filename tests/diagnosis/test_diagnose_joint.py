"""Several recordings of one wavefront diagnosed together; HCIPy makes the images (independent code)."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.diagnose_cases import (
    CASE,
    CONDITIONS,
    FLUX_E,
    FRAMES,
    HIGHEST_NOLL,
    TRUE_NM,
    WAVELENGTH_NM,
    options,
)
from helpers.light_path_derivatives import assert_gradient
from helpers.optics_cases import READ_NOISE, draw_frames, everything
from helpers.reference_psf import reference

from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.verdict import Diagnosis
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import TipTiltJitter
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf_settings import KnownWavefront

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("joint")]  # each diagnosis is made once
NOLLS = tuple(range(2, HIGHEST_NOLL + 1))
STATED = ({6: -170.0}, {})  # diversities of the two recordings
REALLY_NM = -130.0  # what the first has
FIRST = torch.arange(1)


def recording(diversity: dict[int, float], real: dict[int, float], seed: int) -> Exposures:
    """Frames with one diversity that are said to have another."""
    imager = reference()
    total = {noll: TRUE_NM.get(noll, 0.0) + real.get(noll, 0.0) for noll in {*TRUE_NM, *real}}
    image = imager.image(imager.opd_nm(total), WAVELENGTH_NM, CASE.window, 9.7)
    images = draw_frames(image * FLUX_E, FRAMES, seed=seed)
    return Exposures(
        Frames(images, everything(images), READ_NOISE),
        replace(CONDITIONS, settings=replace(CASE, known=KnownWavefront(diversity))),
    )


def means(taken: list[Exposures]) -> Stacks:
    """All frames of every recording."""
    stacks = (Stack.of(one.frames, np.linspace(0, 1, len(one.frames.images_e))) for one in taken)
    return Stacks(tuple(replace(stack, photon_limited=True) for stack in stacks))


def wrong_lens() -> list[Exposures]:
    """With a lens that is not as stated, and without it."""
    return [recording(STATED[0], {6: REALLY_NM}, 1), recording(STATED[1], {}, 2)]


@functools.cache
def together() -> Diagnosis:
    return diagnose(wrong_lens(), [], options())


@functools.cache
def alone() -> Diagnosis:
    return diagnose(wrong_lens()[:1], [], options())


def test_an_error_of_the_diversity_cannot_be_seen_in_one_recording():
    assert alone().verdict == "none"
    assert "diversity_error" in alone().untestable


def test_with_a_second_diversity_its_error_is_named_with_its_size():
    (step,) = together().steps
    assert step.name == "diversity_error"
    assert "diversity_error" not in together().untestable
    stated_more_nm = -(REALLY_NM - STATED[0][6])  # along the diversity's own direction
    assert step.public["nm"] == pytest.approx(stated_more_nm, abs=4 * step.sigma["nm"])


def test_the_ncpa_that_it_was_taken_for_is_right_then():
    column = alone().nolls.index(6)
    wrong, right = (d.modes_nm[1][column] - TRUE_NM[6] for d in (alone(), together()))
    assert wrong == pytest.approx(REALLY_NM - STATED[0][6], abs=3)
    assert abs(right) < 3


def test_one_recording_in_two_halves_is_fitted_as_the_whole():
    """Same frames, same settings: the joint fit must give the estimate of the pooled frames."""
    whole = recording({6: -170.0}, {6: -170.0}, 3)
    halves = [
        replace(whole, frames=replace(whole.frames, images_e=part))
        for part in whole.frames.images_e.split(16)
    ]
    estimates = []
    for taken in ([whole], halves):
        fitted = Fitter([one.view(NOLLS, "cpu") for one in taken], means(taken)).fit([TipTiltJitter()])
        estimates.append((fitted.modes_nm[2:], fitted.solution.sigma[0, 2 : len(NOLLS)].numpy()))
    assert np.all(np.abs(estimates[0][0] - estimates[1][0]) < 0.5 * estimates[0][1])
    assert estimates[1][1] == pytest.approx(estimates[0][1], rel=0.1)


def test_gradients_of_the_joint_fit_are_those_of_finite_differences():
    taken = wrong_lens()
    problem = Fitter([one.view(range(2, 8), "cpu") for one in taken], means(taken)).fit([]).problem
    x = torch.zeros(1, problem.size, dtype=torch.float64)
    x[0, :6] = torch.tensor([5.0, -8.0, 30.0, 12.0, -20.0, 6.0])
    x[0, 6:8], x[0, 8], x[0, -2] = torch.tensor([3.0, 9.0]), 0.9 * FLUX_E, 1.1 * FLUX_E
    gradient = problem.normal_equations(x, FIRST)[1]
    steps = {0: 1e-3, 2: 1e-3, 6: 1e-3, 8: 1.0, problem.size - 2: 1.0}
    assert_gradient(lambda at: problem.objective(at, FIRST), gradient, x, steps, rel=1e-4)


def test_the_second_recording_that_shows_an_error_of_the_diversity_is_the_one_without_it():
    """Out of focus by a stage, the same lens hides the same error; without the lens Noll 6 stands alone."""
    advice = alone().advice["diversity_error"]
    assert advice.recording == "without the diversity"
    assert advice.smallest["nm"] < 5


def test_two_recordings_of_other_diversity_need_no_further_one_for_it():
    assert "diversity_error" not in together().advice
