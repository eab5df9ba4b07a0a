"""`high_aperture` in model, simulator and diagnosis of a ramp. Truth: closed forms, and what was put in."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.effect_cases import CONDITIONS

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.diagnosis.ramp.gap import compare
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.focus_table import defocus_nm_per_um, shaped_modes
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.simulate.effects.wavefront import HighAperture as Simulated
from irlos_pipe.simulate.telescope import Telescope

SINE, DIAMETER_M = 0.85, 1.7
PIXEL_MAS = np.rad2deg(130e-9) * 3.6e6
OFFSETS_NM = np.linspace(-320.0, 320.0, 9)
STATIC = {6: 20.0, 7: -15.0, 11: 18.0}
SETTINGS = PsfSettings(
    PupilGeometry(DIAMETER_M, 0.0, ()),
    (33, 33),
    PIXEL_MAS,
    ((520.0, 1.0),),
    replace(CONDITIONS.settings.known, diversity_nm={}),
    pupil_samples=64,
    margin_mas=150.0,
    halo_margin_mas=300.0,
)


def test_the_simulator_makes_the_shape_of_the_model():
    grid = PsfModel(SETTINGS, (4,)).pupil_grid
    telescope = Telescope(PupilGeometry(DIAMETER_M, 0.0, ()), grid.u_m, np.ones_like(grid.amplitude))
    simulated = Simulated(SINE).defocus(telescope)
    inside = np.hypot(*np.meshgrid(grid.u_m, grid.u_m)) < 0.99 * DIAMETER_M / 2
    modelled = shaped_modes(grid, [4], SINE)[0]
    assert np.ptp((simulated - modelled)[inside]) < 2e-3 * np.ptp(modelled[inside])
    rho2 = np.add.outer(grid.u_m**2, grid.u_m**2)[inside] / (DIAMETER_M / 2) ** 2
    path_nm = 1e3 * (1 - np.sqrt(1 - SINE**2 * rho2))
    assert np.ptp(simulated[inside] * defocus_nm_per_um(SINE) - path_nm) < 1e-6 * np.ptp(path_nm)


@pytest.fixture(scope="module")
def ramps():
    """The same ramp, made with high aperture, fitted with the parabola and with the sphere."""
    high = replace(SETTINGS, focus_sine=SINE)
    nolls = (4, *STATIC)
    modes = np.column_stack([OFFSETS_NM, *(np.full(len(OFFSETS_NM), nm) for nm in STATIC.values())])
    mean = 4e5 * PsfModel(high, nolls, dtype=torch.float64).images(torch.as_tensor(modes)) + 5
    rng = np.random.default_rng(5)
    images = torch.as_tensor(rng.poisson(mean.numpy()) + rng.normal(0, 3, mean.shape))
    data = RampData(images, torch.ones(33, 33, dtype=torch.bool), NoiseModel(1.0, 9.0), OFFSETS_NM)
    start = torch.zeros(len(OFFSETS_NM), 3, dtype=torch.float64)
    start[:, 2] = torch.as_tensor(OFFSETS_NM)
    held_out = np.arange(len(OFFSETS_NM)) % 4 == 3
    fits = [
        fit_ramp(
            PsfModel(settings, (2, 3, 4), dtype=torch.float64),
            data,
            start,
            LiftOptions(),
            [HighOrderNcpa(list(STATIC))],
            seen=~held_out,
        )
        for settings in (SETTINGS, high)
    ]
    return SimpleNamespace(data=data, parabola=fits[0], sphere=fits[1], held_out=held_out)


def test_lift_with_a_common_wavefront_finds_ramp_and_wavefront(ramps):
    found = ramps.sphere.effects["high_order_ncpa"]["zernike_nm"]
    assert {int(noll): nm for noll, nm in found.items()} == pytest.approx(STATIC, abs=1.0)
    assert ramps.sphere.defocus_nm == pytest.approx(OFFSETS_NM, abs=3.0)
    assert ramps.sphere.result.chi2_nu.numpy() == pytest.approx(1.0, abs=0.2)


def test_held_out_images_want_the_sphere(ramps):
    found = compare(ramps.data, ramps.parabola, ramps.sphere, ramps.held_out)
    assert found.favours(5.0) and found.better == 1.0
    assert found.gap[1] < 0.7 * found.gap[0]
    assert not compare(ramps.data, ramps.sphere, ramps.parabola, ramps.held_out).favours(5.0)
    assert not compare(ramps.data, ramps.sphere, ramps.sphere, ramps.held_out).favours(5.0)
