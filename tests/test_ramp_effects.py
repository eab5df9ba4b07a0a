"""The choice of LIFT's effects. Truth: the effects themselves, whose OTF factors are compared."""

from __future__ import annotations

import pytest
import torch
from optics_cases import BAND, NARROW_H, settings

from irlos_pipe.effects import OtfGrid, Pinned, SeeingHalo, TipTiltJitter, Transfer, expected
from irlos_pipe.estimate.ramp_effects import ramp_effects
from irlos_pipe.psf import PsfModel

AVAILABLE = (SeeingHalo(BAND, 0.5), TipTiltJitter())
MEASURED = Pinned(AVAILABLE[0], AVAILABLE[0].values_of(wfe_nm=150.0))


@pytest.fixture(scope="module")
def grid() -> OtfGrid:
    model = PsfModel(settings(16, NARROW_H), (4,))
    return OtfGrid(model.grid, model.wavelengths_m)


def factor(effects, grid) -> torch.Tensor:
    transfer = Transfer(effects, grid)
    return transfer(torch.tensor([p.start for p in transfer.parameters], dtype=torch.float64))


def test_what_a_calibration_has_measured_is_taken_and_the_rest_is_as_expected(grid):
    chosen = ramp_effects(AVAILABLE, {"seeing_halo": MEASURED})
    truth = factor([MEASURED, TipTiltJitter(7.0)], grid)
    torch.testing.assert_close(factor(chosen, grid), truth)
    assert not any(effect.parameters for effect in chosen)


def test_without_a_calibration_everything_is_as_expected(grid):
    torch.testing.assert_close(factor(ramp_effects(AVAILABLE, {}), grid), factor(expected(AVAILABLE), grid))


def test_a_kernel_given_in_mas_replaces_the_measured_one(grid):
    chosen = ramp_effects(AVAILABLE, {}, halo="off", object_sigma_mas=12.0)
    torch.testing.assert_close(factor(chosen, grid), factor([TipTiltJitter(12.0)], grid))
    assert not any(effect.parameters for effect in chosen)


def test_fitting_frees_the_variance_of_the_residual_and_of_the_kernel():
    chosen = ramp_effects(AVAILABLE, {"seeing_halo": MEASURED}, halo="fit", object_sigma_mas="fit")
    free = [parameter for effect in chosen for parameter in effect.parameters]
    assert [parameter.name for parameter in free] == ["variance_nm2", "variance_mas2"]
    assert free[0].start == pytest.approx(MEASURED.values[0])


def test_a_model_without_effects_stays_without():
    assert ramp_effects((), {}) == []
