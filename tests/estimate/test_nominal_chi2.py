"""χ²/ν that a right model has, and mixtures of two kinds of frames.

Truth: Monte Carlo of linear models with noise that pixels share; Gaussian scatter and a vibration.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from irlos_pipe.estimate.calibration_errors import Part, nominal_chi2, nominal_power
from irlos_pipe.estimate.cube import Frames, kurtosis_of_frames, mean_variance_e2
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.image_quality import power_spectrum

SIDE, COUNT, PARAMETERS = 16, 40, 12
PIXELS = SIDE * SIDE
NOISE = NoiseModel(1.0, 1.0)
SKY = 100.0  # photons per pixel


def _cube(rng: np.random.Generator, shared: np.ndarray) -> Frames:
    """Photon noise on a plain background, and patterns of random strength from frame to frame."""
    images = rng.poisson(SKY, (COUNT, PIXELS)) + rng.normal(size=(COUNT, len(shared))) @ shared
    images = torch.as_tensor(images.reshape(COUNT, SIDE, SIDE))
    return Frames(images, torch.ones(SIDE, SIDE, dtype=torch.bool), NOISE)


def _left(*parts: Part, size: int = PARAMETERS) -> torch.Tensor:
    """What the weighted linear fit to mean images leaves; the truth is the plain background."""
    rows, data = [], []
    for part in parts:
        root = mean_variance_e2(part.frames).flatten() ** -0.5
        wide = torch.zeros(PIXELS, size, dtype=torch.float64)
        wide[:, list(part.columns)] = (part.jacobian * root).mT
        rows.append(wide)
        data.append((part.frames.mean_e.flatten() - SKY) * root)
    wide, given = torch.cat(rows), torch.cat(data)
    return given - wide @ torch.linalg.lstsq(wide, given[:, None]).solution[:, 0]


@pytest.mark.parametrize("patterns", [0, 30])
def test_the_frames_tell_mean_and_scatter_of_chi2_about_a_right_model(patterns):
    """A part of the patterns lies within the model's reach, so that their χ²/ν is not 1."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(PARAMETERS, PIXELS))
    inside = rng.normal(size=(patterns, PARAMETERS)) @ jacobian
    shared = 10 * rng.normal(size=(patterns, PIXELS)) + 6 * inside
    jacobian = torch.as_tensor(jacobian)
    found, told = [], []
    for _ in range(60):
        frames = _cube(rng, shared)
        part = Part(frames, jacobian, range(PARAMETERS))
        left = _left(part)
        found.append(float(left.square().sum()) / (PIXELS - PARAMETERS))
        told.append(nominal_chi2([part], torch.zeros(PARAMETERS)))
    found, value = np.array(found), np.array([one.value for one in told])
    assert np.mean(value) == pytest.approx(np.mean(found), abs=4 * np.std(found) / np.sqrt(60))
    pulls = (found - value) / [one.sigma for one in told]
    assert 0.7 < np.std(pulls) < 1.3
    if patterns:
        assert np.mean(found) < 0.9


def test_the_frames_tell_the_power_spectrum_about_a_right_model():
    """Truth: the mean spectrum of what linear fits leave of the means of many cubes."""
    rng = np.random.default_rng(7)
    y, x = np.indices((SIDE, SIDE))
    waves = [np.cos(2 * np.pi * (2 * x + k * y) / SIDE).ravel() for k in range(PARAMETERS)]
    jacobian = torch.as_tensor(np.array(waves))
    shared = 6 * np.array([np.sin(2 * np.pi * (2 * x + k * y) / SIDE).ravel() for k in range(4)])
    problem = SimpleNamespace(
        predict_and_jacobian=lambda values: (None, jacobian[None]),
        prior_precision=torch.zeros(1, PARAMETERS),
        model=SimpleNamespace(psf=SimpleNamespace(settings=SimpleNamespace(resolution_px=2.0))),
    )
    found, told = [], []
    for _ in range(40):
        frames = _cube(rng, shared)
        part = Part(frames, jacobian, range(PARAMETERS))
        nominal = nominal_chi2([part], torch.zeros(PARAMETERS))
        told.append(nominal_power(frames, problem, torch.zeros(1, PARAMETERS), nominal))
        left = _left(part)
        found.append(power_spectrum(left.reshape(SIDE, SIDE).numpy(), 2.0).value)
    error = np.std(found, axis=0) / np.sqrt(40)
    assert np.all(np.abs(np.mean(told, axis=0) - np.mean(found, axis=0)) < 4 * error)
    assert np.ptp(np.mean(told, axis=0)) > 0.2  # it is not white


def test_images_fitted_together_have_the_chi2_that_their_frames_tell():
    """Two cubes share half of their parameters: a deviation of one leaves its mark in the other too."""
    rng = np.random.default_rng(7)
    columns = [range(PARAMETERS), [*range(PARAMETERS // 2), *range(PARAMETERS, PARAMETERS * 3 // 2)]]
    jacobians = [rng.normal(size=(PARAMETERS, PIXELS)) for _ in columns]
    shared = [
        10 * rng.normal(size=(4, PIXELS)) + 12 * rng.normal(size=(4, PARAMETERS)) @ j for j in jacobians
    ]
    size = PARAMETERS * 3 // 2
    found, told = [], []
    for _ in range(60):
        cubes = [_cube(rng, one) for one in shared]
        parts = [
            Part(frames, torch.as_tensor(jacobian), own)
            for frames, jacobian, own in zip(cubes, jacobians, columns, strict=True)
        ]
        told.append(nominal_chi2(parts, torch.zeros(size)).value)
        found.append(float(_left(*parts, size=size).square().sum()) / (2 * PIXELS - size))
    assert np.mean(told) == pytest.approx(np.mean(found), abs=4 * np.std(found) / np.sqrt(60))


# -- mixtures of two kinds of frames -------------------------------------------------------------


KINDS_SIDE = 12


def _kurtosis(images: np.ndarray) -> float:
    good = torch.ones(KINDS_SIDE, KINDS_SIDE, dtype=torch.bool)
    return kurtosis_of_frames(Frames(torch.as_tensor(images), good, NoiseModel(1.0, 1.0)))


@pytest.mark.parametrize(
    ("strength", "most"),
    [
        (np.tile([50.0, -50.0], COUNT // 2), 1.1),
        (np.repeat([50.0, -50.0], [16, 24]), 1.3),
        (np.repeat([50.0, -50.0], 4), 1.05),
    ],
)
def test_frames_with_a_pattern_of_either_sign_are_two_kinds(strength, most):
    rng = np.random.default_rng(1)
    pattern = rng.normal(size=(KINDS_SIDE, KINDS_SIDE))
    noise = rng.poisson(100.0, (len(strength), KINDS_SIDE, KINDS_SIDE))
    assert _kurtosis(noise + strength[:, None, None] * pattern) < most


def test_few_frames_with_gaussian_scatter_are_one_kind():
    """By chance one of 5000 such cubes would be two; the limit is stated for the Gaussian strengths alone."""
    rng = np.random.default_rng(2)
    pattern = rng.normal(size=(KINDS_SIDE, KINDS_SIDE))
    found = [_kurtosis(200.0 + rng.normal(0, 50, (8, 1, 1)) * pattern) for _ in range(200)]
    assert np.isnan(found).all()


def test_a_star_that_is_dimmed_half_way_is_one_kind():
    rng, image = np.random.default_rng(3), np.full((KINDS_SIDE, KINDS_SIDE), 20.0)
    image[4:8, 4:8] = 2000.0
    images = rng.poisson(np.repeat([1.0, 0.5], COUNT // 2)[:, None, None] * image).astype(float)
    assert not _kurtosis(images) < 2
