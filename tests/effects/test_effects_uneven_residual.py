"""An AO residual that is stronger in some places of the pupil.

Truth: a Monte Carlo average of HCIPy images through screens whose variance differs from place to place
(independent code); the simulator, whose screens are scaled place by place.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.optics_cases import BAND, NARROW_H, RESIDUAL_LAW, settings
from helpers.reference_psf import reference
from helpers.residual_screens import screens_nm

from irlos_pipe.effects import EffectSet, FixedEffect, SeeingHalo
from irlos_pipe.effects.seeing_halo import NOLLS, UnevenResidual, in_band_wfe_nm
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.calibrations import DEFAULT, VARIANTS, ObservedCube
from irlos_pipe.paper.common.scenes import cube_scene

SEEING_ARCSEC, SCREENS = 0.8, 800
UNEVEN = {"edge": 0.35, "side_x": -0.15, "side_y": 0.1}
VALUES = torch.tensor(list(UNEVEN.values()), dtype=torch.float64)
ABERRATED = {5: 60.0, 6: -170.0, 7: 40.0, 9: 50.0}


@pytest.mark.slow
def test_the_long_exposure_is_the_mean_of_images_through_uneven_screens():
    wavelength_nm, window = NARROW_H[0][0], (32, 32)
    imager = reference(96)
    rms_nm = in_band_wfe_nm(BAND, RESIDUAL_LAW, SEEING_ARCSEC)
    variance = 1 + imager.opd_nm({noll: UNEVEN[name] for name, noll in NOLLS.items()})
    screens = screens_nm(imager, 2.0, rms_nm, SCREENS, seed=5, variance=np.maximum(variance, 0))
    still_nm = imager.opd_nm(ABERRATED)
    drawn = np.array([imager.image(still_nm + one, wavelength_nm, window, 9.7) for one in screens])
    error = drawn.std(0, ddof=1) / np.sqrt(SCREENS)
    model = PsfModel(settings(window, diversity=ABERRATED), (4,), dtype=torch.float64)
    # Good seeing leaves next to nothing beyond the cut-off, as in the screens.
    halo = FixedEffect(SeeingHalo(BAND, RESIDUAL_LAW, 0.01), [rms_nm**2, 2.0, *[0.0] * 5])

    def mean_square_pull(effects, values=None) -> float:
        ours = model.images(torch.zeros(1, 1), EffectSet(effects, model.grids)(values))[0].numpy()
        return np.mean(((ours - drawn.mean(0)) / error) ** 2)

    uneven = mean_square_pull([halo, UnevenResidual(BAND, RESIDUAL_LAW, SEEING_ARCSEC)], VALUES)
    assert 0.3 < uneven < 2
    assert mean_square_pull([halo]) > 5 * uneven


@pytest.mark.slow
def test_a_calibration_finds_what_the_simulated_screens_have():
    facility = load_instrument("irlos").facility
    scene = cube_scene("cube", (5, 0), facility, SEEING_ARCSEC, 80, 7.0)
    sky = replace(scene.sky, variance_zernike={noll: UNEVEN[name] for name, noll in NOLLS.items()})
    cube = ObservedCube.of(replace(scene, sky=sky))
    uneven = UnevenResidual(cube.effects[0].band, facility.residual_law, SEEING_ARCSEC)
    found = cube.calibrated(VARIANTS[DEFAULT], [uneven])
    values, sigma = found.effects["uneven_residual"], found.effects_sigma["uneven_residual"]
    for name, true in UNEVEN.items():
        assert sigma[name] < 0.08
        assert values[name] == pytest.approx(true, abs=3 * sigma[name])
