"""`lenslet_images`. Truth: a tilt of the wavefront before one lenslet, and finite differences."""

import pytest
import torch
from helpers.lenslet_cases import lenslet_settings

from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.effects import EffectSet
from irlos_pipe.effects.lenslet_images import LensletImages
from irlos_pipe.optics.lenslets import LensletArray, apart

SETTINGS = lenslet_settings(20)
VALUES = {"x_mas": [20.0, 0.0, -5.0, 0.0], "y_mas": [0.0, -15.0, 5.0, 0.0], "flux": [0.0, 0.0, 0.2, -0.1]}
WAVEFRONT = torch.tensor([[10.0, -5.0, 60.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def psf() -> LensletArray:
    return LensletArray(SETTINGS, (2, 3, 4), dtype=torch.float64)


def test_an_image_moves_as_by_a_tilt_of_its_part_of_the_wavefront(psf):
    effect = LensletImages()
    values = torch.tensor(effect.values_of(**VALUES), dtype=torch.float64)
    images = apart(psf.images(WAVEFRONT, EffectSet([effect], psf.grids)(values))[0])
    for lenslet, image in enumerate(images):
        x_mas, y_mas, flux = (VALUES[key][lenslet] for key in ("x_mas", "y_mas", "flux"))
        tilts = torch.tensor([[tilt_nm(x_mas, 8.0), tilt_nm(y_mas, 8.0), 0.0]], dtype=torch.float64)
        expected = (1 + flux) * apart(psf.images(WAVEFRONT + tilts)[0])[lenslet]
        assert (image - expected).abs().max() < 1e-4 * expected.max()


def test_slopes_are_finite_differences(psf):
    effects = EffectSet([LensletImages()], psf.grids)
    values = torch.tensor(LensletImages().values_of(**VALUES), dtype=torch.float64)
    _, jacobian = psf.images_and_jacobian(WAVEFRONT, effects(values), effects.tangents(values))
    for index in range(12):
        step = torch.zeros(12, dtype=torch.float64)
        step[index] = 1e-3
        ends = [psf.images(WAVEFRONT, effects(values + sign * step)) for sign in (1, -1)]
        slope = (ends[0] - ends[1])[0] / 2e-3
        assert (jacobian[0, 3 + index] - slope).abs().max() < 1e-5 * slope.abs().max()
