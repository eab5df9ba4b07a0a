"""Sampling for single frames.

Truth: noise-free images of the same light path, sampled three times as finely (convergence of the same code).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import READ_NOISE, everything, ncpa_nm, settings

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import FRAME_PUPIL_SAMPLES

SPECTRUM = ((1170.0, 0.5), (1625.0, 0.5))
NOLLS = (2, 3, 4)


@pytest.mark.slow
def test_the_defocus_of_bright_frames_errs_by_a_hundredth_of_a_nanometre():
    truth_nm = torch.tensor([[20.0, -30.0, defocus] for defocus in (-300.0, 0.0, 300.0)]).double()
    diversity = ncpa_nm(3)
    diversity[6] -= 170.0
    fine = settings(64, SPECTRUM, diversity, pupil_samples=3 * FRAME_PUPIL_SAMPLES)
    images_e = 1e6 * PsfModel(fine, NOLLS, dtype=torch.float64).images(truth_nm)
    model = ImageModel(PsfModel(fine.for_single_frames(), NOLLS))
    start_nm = truth_nm + 5.0
    found = lift(model, images_e.float(), everything(images_e), READ_NOISE, start_nm, LiftOptions("model"))
    assert np.abs((found.zernike_nm - truth_nm)[:, 2].numpy()).max() < 0.02
    assert found.sigma_nm[:, 2].min() > 0.1
