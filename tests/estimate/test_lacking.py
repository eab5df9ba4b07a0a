"""A fact told wrongly is named by one linear step. Truth: images of the model itself with another fact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.residual import Lacking, lacking
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.optics.psf import PsfModel

NOLLS, WINDOW, FLUX_E = tuple(range(2, 16)), 40, 1e6
SETTINGS = cases.settings(WINDOW)
PLACE = torch.tensor([[*np.linspace(30, -20, len(NOLLS)), FLUX_E, 5.0]], dtype=torch.float64)


def found(settings, expected_chi2_nu: float = 1.0) -> tuple[Lacking, float]:
    """What an image taken with other `settings` seems to lack, and its χ²/ν by the model as told."""
    truth = ImageModel(PsfModel(settings, NOLLS, dtype=torch.float64))
    image_e = truth.predict(PLACE[:, :-2], PLACE[:, -2], PLACE[:, -1], truth.effects.starts)
    data = torch.poisson(image_e.clamp_min(0), generator=torch.Generator().manual_seed(1)).reshape(1, 1, -1)
    model = ImageModel(PsfModel(SETTINGS, NOLLS, dtype=torch.float64))
    problem = ImageFit(model, Layout(NOLLS), data, data + 9.0)
    x = solve(problem, PLACE).values
    chi2_nu = float(problem.reduced_chi2(x)[0])
    return lacking(problem, x, max(1 - expected_chi2_nu / chi2_nu, 0.01)), chi2_nu


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_pixels_told_two_per_cent_wrong_are_named_with_what_looks_alike(factor):
    true_mas = SETTINGS.pixel_scale_mas * factor
    lacks, chi2_nu = found(replace(SETTINGS, pixel_scale_mas=true_mas))
    assert chi2_nu > 2 and lacks.part > 0.8
    pixels, spectrum = lacks.text.split(" or ")
    assert float(pixels.split()[2]) == pytest.approx(true_mas, rel=0.002)
    wavelength_nm = float(spectrum.split()[3])
    assert wavelength_nm == pytest.approx(SETTINGS.mean_nm / factor, rel=0.01)


@pytest.mark.slow
def test_of_a_right_model_noise_leaves_nothing_to_name():
    lacks, chi2_nu = found(SETTINGS, 0.5)
    assert chi2_nu < 1.2
    assert lacks.text == "" and lacks.part < 0.2
