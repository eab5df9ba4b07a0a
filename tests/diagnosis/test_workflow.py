"""Where a search ends in a deeper minimum of the model as it was. Truth: made-up χ²."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from irlos_pipe.diagnosis import workflow
from irlos_pipe.diagnosis.workflow import deeper_null

FALSE_CHI2_NU = 7.5


def searched(labels: list[str]) -> SimpleNamespace:
    """A search that began in a false minimum and ended with some effects."""
    effects = SimpleNamespace(labels=labels)
    final = SimpleNamespace(problem=SimpleNamespace(effects=effects), continued=lambda: labels)
    null = SimpleNamespace(stack=None, excess=SimpleNamespace(chi2_nu=FALSE_CHI2_NU))
    return SimpleNamespace(null=null, final=SimpleNamespace(fitted=final))


@pytest.mark.parametrize(
    ("labels", "chi2_nu", "taken"),
    [
        (["seeing_halo"], 1.5, True),
        (["seeing_halo"], 7.0, False),
        (["seeing_halo"], float("nan"), False),
        (["seeing_halo", "companion"], 1.5, False),
    ],
)
def test_a_far_deeper_minimum_of_the_same_model_is_where_to_begin_again(monkeypatch, labels, chi2_nu, taken):
    refitted = SimpleNamespace()
    excess = SimpleNamespace(excess=SimpleNamespace(chi2_nu=chi2_nu))
    monkeypatch.setattr(workflow, "Optimum", lambda stack, fitted: excess)
    fitter = SimpleNamespace(fit=lambda effects, near: refitted)
    told = [SimpleNamespace(name="seeing_halo")]
    assert deeper_null(searched(labels), told, fitter) is (refitted if taken else None)
