"""Whether the loop is closed. Truth: a simulated focus that answers, or not, and the controller."""

import numpy as np
import pytest

from irlos_pipe.control.controller import ControllerSettings, ControllerState, Response, decide
from irlos_pipe.control.linear_theory import SodiumLayer

DRIFT = SodiumLayer(1.95, 23.0, 89.4e3).drift(8.0)


def followed(
    answer, noise_nm=10.0, exposures=1000, delay=1, thermal_nm=0.0, seed=0, late=0
) -> tuple[int, str]:
    """Exposures until the verdict, and the verdict; `answer` is the part of a change that is applied."""
    rng = np.random.default_rng(seed)
    disturbance_nm = 60.0 + DRIFT.draw_nm(rng, exposures, 1.0) + thermal_nm * np.arange(exposures)
    settings, state = ControllerSettings(gain=0.4, delay=delay), ControllerState()
    response, commanded, applied_nm = Response(delay), [0.0] * (delay + late + 2), 0.0
    for index in range(exposures):
        applied_nm += answer(index) * (commanded[-1 - delay - late] - commanded[-2 - delay - late])
        measured_nm = disturbance_nm[index] - applied_nm + rng.normal(0, noise_nm)
        if verdict := response.verdict(measured_nm, state.offset_nm):
            return index, verdict
        state = decide(state, measured_nm, settings).state
        commanded.append(state.offset_nm)
    return exposures, ""


@pytest.mark.parametrize("noise_nm", [2.0, 20.0, 80.0])
@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("thermal_nm", [0.0, 2.0])
def test_a_closed_loop_is_never_stopped_whatever_it_follows(noise_nm, delay, thermal_nm):
    assert followed(lambda _: 1.0, noise_nm, delay=delay, thermal_nm=thermal_nm) == (1000, "")


@pytest.mark.parametrize(("answer", "late"), [(0.8, 0), (1.2, 0), (1.0, 1)])
def test_nor_is_one_that_answers_by_a_little_more_or_less_or_later(answer, late):
    assert followed(lambda _: answer, late=late)[1] == ""


@pytest.mark.parametrize(
    ("answer", "words"),
    [(0.0, "not answered"), (-1.0, "wrong sign|not answered"), (2.0, "twice")],
    ids=["stuck", "wrong sign", "twice"],
)
@pytest.mark.parametrize("seed", range(3))
def test_a_focus_that_does_not_answer_as_it_should_is_found(answer, words, seed):
    exposures, verdict = followed(lambda index: 1.0 if index < 100 else answer, seed=seed)
    assert any(word in verdict for word in words.split("|"))
    assert 100 < exposures < 400
