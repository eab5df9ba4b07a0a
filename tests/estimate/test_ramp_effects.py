"""The choice of LIFT's effects. Truth: the effects themselves, whose OTF factors are compared."""

from __future__ import annotations

import pytest
import torch
from helpers.optics_cases import BAND, NARROW_H, RESIDUAL_LAW, settings

from irlos_pipe.effects import EffectSet, FixedEffect, SeeingHalo, TipTiltJitter, expected
from irlos_pipe.estimate.ramp_fit import ramp_effects
from irlos_pipe.optics.grids import Grids
from irlos_pipe.optics.psf import PsfModel

AVAILABLE = (SeeingHalo(BAND, RESIDUAL_LAW, 0.5), TipTiltJitter())
MEASURED = FixedEffect(AVAILABLE[0], AVAILABLE[0].values_of(wfe_nm=150.0))


@pytest.fixture(scope="module")
def grids() -> Grids:
    return PsfModel(settings(16, NARROW_H), (4,)).grids


def factor(effects, grids: Grids) -> torch.Tensor:
    together = EffectSet(effects, grids)
    return together(together.starts).transfer


def test_what_a_calibration_has_measured_is_taken_and_the_rest_is_as_expected(grids):
    chosen = ramp_effects(AVAILABLE, {"seeing_halo": MEASURED})
    truth = factor([MEASURED, TipTiltJitter(7.0)], grids)
    torch.testing.assert_close(factor(chosen, grids), truth)
    assert not any(effect.parameters for effect in chosen)


def test_without_a_calibration_everything_is_as_expected(grids):
    truth = factor(expected(AVAILABLE), grids)
    torch.testing.assert_close(factor(ramp_effects(AVAILABLE, {}), grids), truth)


def test_a_kernel_given_in_mas_replaces_the_measured_one(grids):
    chosen = ramp_effects(AVAILABLE, {}, halo="off", object_sigma_mas=12.0)
    torch.testing.assert_close(factor(chosen, grids), factor([TipTiltJitter(12.0)], grids))
    assert not any(effect.parameters for effect in chosen)


def test_fitting_frees_the_variance_of_the_residual_and_of_the_kernel():
    chosen = ramp_effects(AVAILABLE, {"seeing_halo": MEASURED}, halo="fit", object_sigma_mas="fit")
    free = [parameter for effect in chosen for parameter in effect.parameters]
    assert [parameter.name for parameter in free] == ["variance_nm2", "variance_mas2"]
    assert free[0].start == pytest.approx(MEASURED.values[0])
