"""OTF effects. Truth: averages of moved images by Gauss-Hermite quadrature, and analysis."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from helpers.optics_cases import (
    BAND,
    J_AND_H,
    MAS_RAD,
    RESIDUAL_LAW,
    SCALE_MAS,
    halo_and_jitter,
    ncpa_nm,
    settings,
    shift_nm,
    vector,
)

from irlos_pipe.effects import EffectSet, FixedEffect, SeeingHalo, TipTiltJitter
from irlos_pipe.optics.grids import Optics, OtfGrid
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 16))
SIGMA_MAS = 12.0


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings((36, 33), J_AND_H[1::3]), NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def wavefront() -> torch.Tensor:
    return vector(ncpa_nm(6, 15, 100.0), NOLLS)


def moved(model: PsfModel, wavefront: torch.Tensor, x_px: float, y_px: float) -> np.ndarray:
    tilted = wavefront.clone()
    tilted[0, :2] += torch.tensor([shift_nm(x_px), shift_nm(y_px)])
    return model.images(tilted)[0].numpy()


def jittered(model: PsfModel, wavefront: torch.Tensor, sigma_mas: float) -> np.ndarray:
    effects = EffectSet((TipTiltJitter(),), model.grids)
    return model.images(wavefront, effects(torch.tensor([sigma_mas**2], dtype=torch.float64)))[0].numpy()


def test_jitter_is_the_average_over_gaussian_image_motion(model, wavefront):
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()
    step = SIGMA_MAS / SCALE_MAS
    average = sum(
        wx * wy * moved(model, wavefront, step * x, step * y)
        for (x, wx), (y, wy) in itertools.product(zip(nodes, weights, strict=True), repeat=2)
    )
    assert jittered(model, wavefront, SIGMA_MAS) == pytest.approx(average, abs=1e-4 * average.max())


def curvature_at_zero(model: PsfModel, factor: torch.Tensor, wavelength: int) -> float:
    """Variance [mas²] along x that an OTF factor adds: -ln T = 2π² σ² b² / λ² at the shortest baseline."""
    baseline = model.grids.focal.baseline_x_m[1] / model.wavelengths_m[wavelength]
    return float(-torch.log(factor[wavelength, 0, 1])) / (2 * np.pi**2 * baseline**2) / MAS_RAD**2


@pytest.mark.parametrize("wavelength", [0, 1])
def test_jitter_adds_its_variance_to_the_second_moment_at_every_wavelength(model, wavelength):
    effects = EffectSet((TipTiltJitter(),), model.grids)
    factor = effects(torch.tensor([SIGMA_MAS**2], dtype=torch.float64)).transfer
    assert curvature_at_zero(model, factor, wavelength) == pytest.approx(SIGMA_MAS**2, rel=1e-9)


def test_an_asymmetric_kernel_is_convolved_not_correlated(model, wavefront):
    """A kernel with 30 % of its light at +3 columns, -2 rows leaves 30 % of the image there."""
    grid, wavelengths = model.grids.focal, torch.as_tensor(model.wavelengths_m)
    angle_x, angle_y = 3 * SCALE_MAS * MAS_RAD, -2 * SCALE_MAS * MAS_RAD
    path = torch.as_tensor(grid.baseline_x_m[None] * angle_x + grid.baseline_y_m[:, None] * angle_y)
    kernel = 0.7 + 0.3 * torch.exp(-2j * np.pi * path / wavelengths[:, None, None])
    image = model.images(wavefront, Optics(transfer=kernel))[0].numpy()
    expected = 0.7 * moved(model, wavefront, 0, 0) + 0.3 * moved(model, wavefront, 3, -2)
    assert image == pytest.approx(expected, abs=1e-4 * expected.max())
    mirrored = 0.7 * moved(model, wavefront, 0, 0) + 0.3 * moved(model, wavefront, -3, 2)
    assert np.abs(image - mirrored).max() > 0.1 * expected.max()


def test_a_residual_stretched_along_x_widens_the_image_along_x(model):
    effects = EffectSet((SeeingHalo(BAND, RESIDUAL_LAW, 0.5),), model.grids)
    factor = effects(torch.tensor([150.0**2, 2.0, 1.5, *[0.0] * 4], dtype=torch.float64)).transfer
    along_x, along_y = float(factor[0, 0, 2]), float(factor[0, 2, 0])
    assert along_x < along_y < 1


@pytest.mark.parametrize("measured", [True, False])
def test_a_residual_of_known_size_is_given_in_nm_or_as_a_part_of_what_is_expected(measured):
    halo = SeeingHalo(BAND, RESIDUAL_LAW, 0.5, measured)
    expected_nm = 104.27 * 0.5 + 58.6
    for values in (halo.values_of(wfe_nm=0.9 * expected_nm), halo.values_of(scale=0.9)):
        assert halo.describe(np.array(values))["wfe_nm"] == pytest.approx(0.9 * expected_nm)


def test_without_a_measured_seeing_the_whole_halo_grows_with_the_residual(model):
    grid = OtfGrid.of(model.grids.focal, model.grids.sampling)
    exponents = {}
    for measured in (True, False):
        halo = SeeingHalo(BAND, RESIDUAL_LAW, 0.5, measured)
        weak, strong = (
            halo.exponent(share * torch.tensor([80.0**2, *[0.0] * 5, 30.0**2]).double(), grid)
            for share in (1, 3)
        )
        exponents[measured] = weak.numpy(), strong.numpy()
    assert exponents[False][1] == pytest.approx(3 * exponents[False][0])
    unchanged = (3 * exponents[True][0] - exponents[True][1]) / 2
    assert unchanged.max() > 0.1 * exponents[True][0].max()


@pytest.mark.parametrize(("seeing_arcsec", "wfe_nm"), [(0.35, 95.1), (1.0, 162.9)])
def test_the_residual_to_start_from_follows_the_seeing_law(seeing_arcsec, wfe_nm):
    """104.27 nm/arcsec x seeing + 58.6 nm."""
    halo = SeeingHalo(BAND, RESIDUAL_LAW, seeing_arcsec)
    assert halo.describe([p.start for p in halo.parameters])["wfe_nm"] == pytest.approx(wfe_nm, abs=0.1)


def pinned(effects: EffectSet, values: torch.Tensor, free: tuple[str, ...]) -> EffectSet:
    pieces = effects.split(values)
    return EffectSet([FixedEffect(e, pieces[e.name], free) for e in effects.effects], effects.grids)


def test_pinned_effects_have_the_otf_of_the_values_they_are_held_at(model):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.3
    held = pinned(effects, values, ())
    assert held.parameters == ()
    assert torch.equal(held().transfer, effects(values).transfer)
    assert held.describe([]) == effects.describe(values)


def test_a_parameter_left_free_starts_at_its_value_and_acts_as_before(model):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.3
    partly = pinned(effects, values, ("slope", "variance_mas2"))
    assert [p.name for p in partly.parameters] == ["slope", "variance_mas2"]
    assert [p.start for p in partly.parameters] == [values[1], values[-1]]
    changed = values.clone()
    changed[1], changed[-1] = 2.9, 30.0
    own = torch.tensor([2.9, 30.0], dtype=torch.float64)
    assert torch.equal(partly(own).transfer, effects(changed).transfer)
    chosen = [effects.tangents(changed).transfer[i] for i in (1, -1)]
    for ours, theirs in zip(partly.tangents(own).transfer, chosen, strict=True):
        assert ours.numpy() == pytest.approx(theirs.numpy(), abs=1e-15)
