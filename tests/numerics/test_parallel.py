"""Worker threads: results must not depend on them. Truth: the same calculation in one thread."""

import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.parallel import ordered_map, workers
from irlos_pipe.optics.psf import PsfModel

TTF = (2, 3, 4)


def fitted(count: int) -> torch.Tensor:
    model = PsfModel(cases.settings(24, cases.J_AND_H), TTF)
    mean = model.images(torch.zeros(1, 3)).double().numpy() * 1e5
    frames = cases.draw_frames(mean[0], 11, seed=1)
    images = frames[:, None].flatten(2)
    variance = cases.READ_NOISE.variance_e2(images.mean(0, keepdim=True))
    problem = ImageFit(ImageModel(model), Layout(TTF), images, variance)
    with workers(count):
        return solve(problem, problem.layout.start(images[:, 0])).values


@pytest.mark.slow
def test_fits_are_the_same_to_the_bit_for_any_number_of_workers():
    """Repeated: a worker that uses two threads inside a product differs now and then only."""
    alone = fitted(1)
    assert all(torch.equal(alone, fitted(3)) for _ in range(20))


@pytest.mark.parametrize("count", [1, 2])
def test_derivatives_by_torch_func_survive_the_workers(count):
    model = PsfModel(cases.settings(24, cases.J_AND_H), TTF, dtype=torch.float64)
    at = torch.tensor([[10.0, -20.0, 30.0]], dtype=torch.float64)
    with workers(count):
        automatic = torch.func.jacfwd(lambda x: model.images(x)[0])(at)[:, :, 0]
        _, jacobian = model.images_and_jacobian(at)
    assert torch.allclose(automatic.permute(2, 0, 1), jacobian[0], rtol=1e-8, atol=1e-14)


def test_an_error_in_a_worker_reaches_the_caller():
    with workers(2), torch.no_grad(), pytest.raises(ZeroDivisionError):
        ordered_map(lambda n: 1 / n, [1, 0])
