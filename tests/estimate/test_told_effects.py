"""Calibrations with effects that a diagnosis found. Truth: the image that the same numbers make, which is to
stay on the way from one problem to the other; made-up objectives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects import FixedEffect, TipTiltJitter
from irlos_pipe.effects.companion import Companion
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.cube_fit import CubeFit
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 12))
PLACE = [0.01, 90.0, -70.0]  # flux ratio, x and y [mas]
NAMES = [parameter.name for parameter in Companion().parameters]


@pytest.fixture(scope="module")
def task() -> CubeFit:
    psf = PsfModel(cases.settings(), NOLLS, dtype=torch.float64)
    modes_nm = cases.vector(cases.ncpa_nm(4, highest_noll=11, total_nm=60.0), NOLLS)
    images = cases.draw_frames(psf.images(modes_nm)[0].double().numpy() * 3e6, 4, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    return CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR), None, None)


def test_releasing_an_effect_changes_no_image(task):
    told, jitter = FixedEffect(Companion(), PLACE, NAMES), TipTiltJitter()
    held = task.fit([told.expected(), jitter])
    problem, values = task.released([told, jitter], held)
    assert problem.layout.size == held[0].layout.size + len(NAMES)
    before, after = held[0].predict(held[1].values), problem.predict(values)
    assert torch.allclose(after, before, rtol=1e-12, atol=1e-9)
    assert np.allclose(
        problem.model.effects.split(values[0, problem.layout.effect_values])["companion"], PLACE
    )
