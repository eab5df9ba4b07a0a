"""The audit of Laplace's method. Truth: a linear Gaussian model, of which Laplace's method is exact."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.diagnose_suite.audit import DRAWS, audited


def linear_model(curved: float = 0.0) -> SimpleNamespace:
    """A posterior at its optimum; `curved` bends the image along the first two parameters."""
    rng = np.random.default_rng(4)
    design, x = torch.as_tensor(rng.standard_normal((40, 5))), torch.as_tensor(rng.standard_normal((1, 5)))
    residual, precision = torch.zeros(40, dtype=torch.float64), torch.full((5,), 0.5, dtype=torch.float64)
    hessian = design.mT @ design + torch.diag(precision)

    def left(at: torch.Tensor) -> tuple[torch.Tensor, float]:
        move = (at - x)[0]
        white = residual - design @ move - curved * design[:, 0] * move[0] * move[1]
        return white, 0.5 * float(white @ white + (precision * move**2).sum())

    posterior = SimpleNamespace(
        covariance=SimpleNamespace(whiten=lambda shapes: shapes),
        left=left,
        prior_precision=precision,
        prior_mean=x[0],
        exact=SimpleNamespace(lower=torch.full((5,), -torch.inf), upper=torch.full((5,), torch.inf)),
    )
    return SimpleNamespace(
        posterior=posterior,
        x=x,
        columns=design.mT,
        hessian=hessian,
        covariance=torch.linalg.inv(hessian),
        fitted=SimpleNamespace(columns_of=lambda label: [0, 1]),
    )


def test_of_a_linear_model_sampling_finds_what_laplace_says():
    found = audited(linear_model(), "effect", np.random.default_rng(1))
    assert found["log_evidence"] == pytest.approx(0.0, abs=0.1)
    assert found["shift"] < 4 / np.sqrt(found["effective"])
    assert found["ratio"] == pytest.approx(1.0, abs=4 / np.sqrt(2 * found["effective"]))
    assert found["effective"] > DRAWS / 2


def test_of_a_curved_one_it_does_not():
    found = audited(linear_model(curved=20.0), "effect", np.random.default_rng(1))
    assert abs(found["log_evidence"]) > 0.3
