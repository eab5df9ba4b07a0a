"""One image, a few frames and thousands: what is held out, errors, and verdicts.

Images are HCIPy's (`diagnose_cases`) or drawn from the model (`diagnose_frames`); expected numbers come from
the statistics of independent noise.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import diagnose_cases as cases
from helpers.diagnose_frames import READ_NOISE, frames, image

from irlos_pipe.diagnosis.cube import PixelStacks, averaged, without_squares
from irlos_pipe.diagnosis.verdict import Diagnosis, sentence
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.estimate.cube import Frames


def few(many: Frames, count: int) -> Frames:
    return replace(many, images_e=many.images_e[:count])


def test_pixels_are_held_out_in_squares_spread_over_bright_and_faint_parts():
    one = few(frames(image()), 1)
    good = one.good.clone()
    good[10, 10] = False
    cube = without_squares(4, replace(one, good=good))
    fitted, judged = (stack.root > 0 for stack in (cube.training, cube.held_out))
    assert not (fitted & judged).any()
    assert torch.equal(fitted | judged, good.flatten())
    assert float(judged.double().mean()) == pytest.approx(0.25, abs=0.01)
    inside = judged.view(8, 4, 8, 4).double().mean((1, 3))  # all of a square or nothing, but the bad pixel
    assert int(((inside > 0) & (inside < 1)).sum()) <= 1
    brightness = one.mean_e.view(8, 4, 8, 4).mean((1, 3)).flatten()
    bright = brightness > brightness.median()
    assert int((inside.flatten()[bright] > 0).sum()) == 8
    assert cube.held_out.parts[0].independent == 16
    again = without_squares(4, replace(one, good=good))
    assert torch.equal(again.held_out.root, cube.held_out.root)


def test_variances_grow_with_the_misfit():
    stack = without_squares(4, few(frames(image()), 1)).training
    residual = 3 * (stack.root > 0).double()
    assert isinstance(stack, PixelStacks)
    assert stack.against(residual / 9, 68).misfit == 1.0
    wrong = stack.against(residual, 68)
    assert wrong.misfit == pytest.approx(9 * 768 / 700)
    shapes = torch.eye(1024, 2).double()
    assert torch.allclose(wrong.covariance_of(shapes), wrong.misfit * stack.covariance_of(shapes))


def test_means_of_consecutive_frames_carry_the_noise_of_means():
    many = frames(image())
    ten = averaged(many, 13)  # 40 frames: 10 means of 4
    assert torch.allclose(ten.images_e[3], many.images_e[12:16].double().mean(0).float())
    assert len(ten.images_e) == 10
    assert averaged(many, 40) is many
    level = torch.tensor([100.0])
    assert ten.noise.variance_e2(level) == pytest.approx(READ_NOISE.variance_e2(level) / 4)
    assert ten.noise.mean_variance_e2(level, 10) == pytest.approx(READ_NOISE.mean_variance_e2(level, 40))


def diagnosis_of(kind: str, count: int, seed: int = 3) -> Diagnosis:
    made = {"plain": cases.plain, "companion": cases.with_companion, "scratch": cases.with_scratch}[kind]()
    return diagnose([Exposures(few(cases.cube(made, seed), count), cases.CONDITIONS)], [], cases.options())


@pytest.mark.slow
def test_nothing_is_missing_in_images_that_the_model_explains():
    verdict = diagnosis_of("plain", 3)
    assert verdict.verdict == "none"
    assert (verdict.held_out, verdict.frames) == ("pixels", (3, 0))
    assert verdict.gap.after == pytest.approx(verdict.gap.floor, rel=0.2)
    assert "ncpa_drift" in verdict.untestable
    assert "pixels that no fit has seen" in sentence(verdict)


@pytest.mark.slow
def test_a_companion_is_named_with_its_size_in_a_single_image():
    verdict = diagnosis_of("companion", 1)
    assert [step.name for step in verdict.steps] == ["companion"]
    found = verdict.steps[0]
    truth = cases.COMPANION["flux_ratio"]
    assert abs(found.public["flux_ratio"] - truth) < 3 * found.sigma["flux_ratio"]
    assert found.sigma["flux_ratio"] < 0.1 * truth
    assert found.gap.shrink > 0.9


@pytest.mark.slow
@pytest.mark.long
def test_what_the_catalogue_lacks_is_unknown_in_a_single_image():
    verdict = diagnosis_of("scratch", 1)
    assert verdict.verdict == "unknown"
    assert np.isfinite(verdict.gap.shrink)
