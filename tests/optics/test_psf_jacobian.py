"""Derivatives of the forward model.

Truth: finite differences of the images in float64, and automatic differentiation of `PsfModel.images`,
whose code shares nothing with the hand-written derivatives but the light path.
"""

from __future__ import annotations

import pytest
import torch
from helpers.optics_cases import J_AND_H, NARROW_H, halo_and_jitter, ncpa_nm, settings, vector

from irlos_pipe.optics.light_path import AS_BUILT
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 22))
SPECTRA = {"mono": NARROW_H, "polychromatic": J_AND_H[::2]}
STEP_NM = 0.05


@pytest.fixture(scope="module", params=SPECTRA, ids=str)
def model(request) -> PsfModel:
    return PsfModel(
        settings((24, 21), SPECTRA[request.param], pupil_samples=64, margin_mas=60.0),
        NOLLS,
        dtype=torch.float64,
    )


@pytest.fixture
def wavefronts() -> torch.Tensor:
    return torch.cat([vector(ncpa_nm(seed, 21), NOLLS) for seed in (1, 2)])


@pytest.fixture(params=[False, True], ids=["without", "with OTF factors"])
def factor(request, model):
    effects = halo_and_jitter(model)
    return effects(effects.starts) if request.param else AS_BUILT


def central_difference(function, x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Derivative of every output with respect to every element of a vector, derivatives first."""
    moves = torch.diag(step)
    return torch.stack([(function(x + move) - function(x - move)) / (2 * move.sum()) for move in moves])


def test_modal_derivatives_are_finite_differences(model, factor, wavefronts):
    _, jacobian = model.images_and_jacobian(wavefronts, factor)
    for frame, x in enumerate(wavefronts):
        numeric = central_difference(
            lambda a: model.images(a[None], factor)[0], x, torch.full_like(x, STEP_NM)
        )
        assert jacobian[frame].numpy() == pytest.approx(
            numeric.numpy(), abs=1e-6 * float(numeric.abs().max())
        )


def test_the_pullback_is_the_transpose_of_finite_differences(model, factor, wavefronts):
    images, pullback = model.images_and_pullback(wavefronts, factor)
    assert images.numpy() == pytest.approx(model.images(wavefronts, factor).numpy(), abs=1e-15)
    factors = torch.randn(images.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    found = pullback(factors)
    for frame, x in enumerate(wavefronts):
        numeric = central_difference(
            lambda a, frame=frame: (model.images(a[None], factor)[0] * factors[frame]).sum(),
            x,
            torch.full_like(x, STEP_NM),
        )
        assert found[frame].numpy() == pytest.approx(numeric.numpy(), abs=1e-6 * float(numeric.abs().max()))


def test_a_single_precision_model_takes_factors_in_double(model, wavefronts):
    """Residuals are summed in float64 whatever the model: its pullback must be that of the double one."""
    rough = PsfModel(model.settings, NOLLS, dtype=torch.float32)
    generator = torch.Generator().manual_seed(4)
    found = []
    for one in (rough, model):
        effects = halo_and_jitter(one)
        images, pullback = one.images_and_pullback(wavefronts, effects(effects.starts))
        factors = torch.randn(images.shape, dtype=torch.float64, generator=generator.manual_seed(4))
        found.append(pullback(factors).double().numpy())
    assert found[0] == pytest.approx(found[1], abs=1e-4 * abs(found[1]).max())


def test_derivatives_of_otf_parameters_are_finite_differences(model, wavefronts):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.1 + 0.05
    _, jacobian = model.images_and_jacobian(wavefronts, effects(values), effects.tangents(values))
    steps = 1e-4 * values.abs().clamp_min(1.0)
    for frame, x in enumerate(wavefronts):
        numeric = central_difference(lambda v, x=x: model.images(x[None], effects(v))[0], values, steps)
        for parameter, ours, theirs in zip(
            effects.parameters, jacobian[frame, len(NOLLS) :], numeric, strict=True
        ):
            tolerance = 1e-6 * float(theirs.abs().max())
            assert ours.numpy() == pytest.approx(theirs.numpy(), abs=tolerance), parameter.name


@pytest.mark.slow
def test_splitting_a_batch_does_not_change_it(model, wavefronts, monkeypatch):
    many = wavefronts.repeat(3, 1)
    together = model.images_and_jacobian(many)
    monkeypatch.setattr("irlos_pipe.optics.psf.CHUNK_ELEMENTS", 1)
    apart = model.images_and_jacobian(many)
    for one, other in zip(together, apart, strict=True):
        assert one.numpy() == pytest.approx(other.numpy(), abs=1e-15)


@pytest.mark.parametrize("noll", [66, 67, 105, 231])
def test_derivatives_of_high_modes_are_finite_differences_whatever_precision_is_asked_for(noll):
    case, nolls = settings((24, 21), NARROW_H, pupil_samples=64), (4, noll)
    x, move = vector({4: 30.0, noll: 5.0}, nolls), vector({noll: STEP_NM}, nolls)
    exact = PsfModel(case, nolls, dtype=torch.float64)
    numeric = (exact.images(x + move) - exact.images(x - move)) / (2 * STEP_NM)
    single = PsfModel(case, nolls, dtype=torch.float32).images_and_jacobian(x)[1][:, 1].double()
    assert float((single - numeric).norm() / numeric.norm()) < 5e-3
