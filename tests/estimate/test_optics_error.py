"""Error of the defocus by that of the NCPAs. Truth: LIFT on images of other optics than it was told."""

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import defocus_slopes, lift, optics_sigma_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

KNOWN, NOISE = tuple(range(2, 16)), NoiseModel(1.0, 1.0)
GOOD = torch.ones(32, 32, dtype=torch.bool)
FOCUS_NM = torch.tensor([-150.0, 0.0, 150.0], dtype=torch.float64)


def images_e(ncpa_nm: dict[int, float]) -> torch.Tensor:
    """Noise-free images at three offsets, of optics with these modes."""
    model = PsfModel(cases.settings((32, 32)), KNOWN, dtype=torch.float64)
    modes_nm = torch.zeros(3, len(KNOWN), dtype=torch.float64)
    for noll, value in ncpa_nm.items():
        modes_nm[:, KNOWN.index(noll)] = value
    modes_nm[:, KNOWN.index(4)] += FOCUS_NM
    return 1e6 * model.images(modes_nm)


def estimated(images: torch.Tensor):
    model = ImageModel(PsfModel(cases.settings((32, 32)), [2, 3, 4], dtype=torch.float64))
    start = torch.zeros(3, 3, dtype=torch.float64)
    start[:, 2] = FOCUS_NM
    return model, lift(model, images, GOOD, NOISE, start)


def test_the_slopes_are_those_of_estimates_with_a_slightly_wrong_ncpa_and_errors_add_up_by_them():
    model, result = estimated(images_e({}))
    wide = ImageModel(PsfModel(model.psf.settings, KNOWN, dtype=torch.float64))
    slopes = np.array([defocus_slopes(model, wide, result, frame, GOOD, NOISE) for frame in range(3)])
    for noll in (4, 5, 6, 8, 11, 14):
        step = 2.0
        found = [estimated(images_e({noll: sign * step}))[1].mode(4)[0].numpy() for sign in (1, -1)]
        numeric = (found[0] - found[1]) / (2 * step)
        assert slopes[:, KNOWN.index(noll)] == pytest.approx(numeric, abs=0.02)
    rng = np.random.default_rng(1)
    root = rng.normal(0, 2, (len(KNOWN), len(KNOWN)))
    drawn = rng.normal(size=(40_000, len(KNOWN))) @ root.T @ slopes.T
    sigma_nm = optics_sigma_nm(model, result, GOOD, NOISE, KNOWN, root @ root.T)
    assert sigma_nm == pytest.approx(drawn.std(axis=0), rel=0.02)
