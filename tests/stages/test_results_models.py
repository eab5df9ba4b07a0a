"""Every stage has a model of its results, which reads products that lack keys. Truth: the registry."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from irlos_pipe.product.results import StageResults
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.lift import stage as lift


def models() -> dict[str, type[StageResults]]:
    """Return the results models of the package by the name of their stage."""
    assert [stage.NAME for stage in STAGES.values()] == list(STAGES)  # imports them all
    own = (
        kind
        for kind in _derived(StageResults)
        if kind.__module__.startswith("irlos_pipe.") and "stage" in vars(kind)
    )
    return {kind.stage: kind for kind in own}


def _derived(kind: type) -> Iterator[type]:
    for derived in kind.__subclasses__():
        yield derived
        yield from _derived(derived)


def test_every_stage_has_a_model_of_its_results():
    assert models().keys() == set(STAGES)


@pytest.mark.parametrize("name", STAGES)
def test_results_without_any_key_can_be_read(name):
    assert models()[name].model_validate({}) == models()[name]()


@pytest.mark.parametrize(
    ("given", "start"), [("told", "commanded"), ("commanded", "commanded"), ("scan", "scan")]
)
def test_the_former_spelling_of_a_start_is_accepted(given, start):
    assert lift.Config(start=given).start == start
