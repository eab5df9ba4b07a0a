"""The controller of the focus loop. Truth: the difference equation written out, and linear theory."""

from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.control.controller import (
    BOOTSTRAP,
    TRACKING,
    ControllerSettings,
    ControllerState,
    Response,
    decide,
)
from irlos_pipe.control.linear_theory import Drift, Integrator, SodiumLayer

SETTINGS = ControllerSettings(gain=0.4, leak=0.0, delay=1, limit_nm=800.0, jump_nm=300.0)
AT_REST = ControllerState()
TRACKED = ControllerState(50.0, TRACKING)


def closed(disturbance_nm, settings=SETTINGS, noise_nm=0.0, seed=0, state=AT_REST):
    """Residuals and states of a loop on a given disturbance, `delay` exposures late."""
    rng, queue = np.random.default_rng(seed), [state.offset_nm] * (settings.delay + 1)
    residuals, states = [], []
    for value in disturbance_nm:
        residual = value - queue.pop(0)
        state = decide(state, residual + noise_nm * rng.standard_normal(), settings).state
        queue.append(state.offset_nm)
        residuals.append(residual)
        states.append(state)
    return np.array(residuals), states


@pytest.mark.parametrize("start_nm", [900.0, -900.0, 150.0, 20.0])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_constant_defocus_is_found_and_taken_off_in_limited_jumps(start_nm, delay):
    settings = ControllerSettings(gain=0.4, delay=delay, jump_nm=300.0)
    residuals, states = closed(np.full(60, start_nm), settings)
    assert abs(residuals[-1]) < 0.1
    assert states[-1].mode == TRACKING
    offsets = np.array([0.0, *(one.offset_nm for one in states)])
    assert np.abs(np.diff(offsets)).max() <= 300.0


@pytest.mark.parametrize(("gain", "frame_s", "delay"), [(0.4, 1.0, 1), (0.15, 2.0, 1), (0.6, 1.0, 0)])
def test_within_its_range_it_is_the_integrator_of_linear_theory(gain, frame_s, delay):
    drift, settings = Drift(2.0, 5.0), replace(SETTINGS, gain=gain, delay=delay)
    rng = np.random.default_rng(1)
    squares = []
    for seed in range(40):
        steps = drift.draw_nm(rng, 4000, frame_s / 10).reshape(400, 10)
        residuals, _ = closed(
            steps.mean(1), settings, noise_nm=6.0, seed=seed, state=ControllerState(0.0, TRACKING)
        )
        squares.append(np.mean(residuals[30:] ** 2))
    found = np.sqrt(np.mean(squares) + drift.wander_within_nm2(frame_s))
    assert found == pytest.approx(Integrator(gain, frame_s, delay).residual_nm(drift, 6.0), rel=0.03)


def test_without_a_valid_measurement_the_offset_is_held_whatever_the_mode():
    for state in (TRACKED, ControllerState(-300.0, BOOTSTRAP), ControllerState(10.0, BOOTSTRAP, settling=1)):
        decision = decide(state, None, ControllerSettings(leak=0.1))
        assert decision.state.offset_nm == state.offset_nm
        assert not decision.commanded


def test_the_offset_is_clipped_and_does_not_wind_up():
    near = ControllerState(790.0, TRACKING)
    decision = decide(near, 100.0, SETTINGS)
    assert (decision.state.offset_nm, decision.clipped, decision.commanded) == (800.0, True, True)
    for _ in range(50):
        decision = decide(decision.state, 100.0, SETTINGS)
    back = decide(decision.state, -50.0, SETTINGS)
    assert back.state.offset_nm == pytest.approx(780.0)
    assert not back.clipped


def test_one_measurement_far_outside_is_not_believed_and_three_start_the_loop_again():
    state = TRACKED
    for _ in range(2):
        decision = decide(state, 500.0, SETTINGS)
        assert (decision.held, decision.state.offset_nm, decision.state.mode) == ("outside", 50.0, TRACKING)
        state = decision.state
    assert decide(state, 10.0, SETTINGS).state.outside == 0
    state = decide(state, 500.0, SETTINGS).state
    assert (state.mode, state.offset_nm) == (BOOTSTRAP, 50.0)
    assert decide(state, 500.0, SETTINGS).state.offset_nm == 350.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"gain": 1.0, "delay": 1}, "stable between 0 and 1.000"),
        ({"gain": 0.7, "delay": 2}, "0.618"),
        ({"gain": 0.4, "delay": 4}, "0.347"),
        ({"leak": 1.0}, "leak"),
        ({"capture_nm": 300.0}, "capture"),
        ({"limit_nm": float("nan")}, "limit_nm nan"),
        ({"gain": float("nan")}, "gain nan"),
    ],
)
def test_settings_that_make_no_stable_loop_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        ControllerSettings(**settings)


# Whether the loop is closed. Truth: a simulated focus that answers, or not, and the controller.


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
