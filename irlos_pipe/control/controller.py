"""The controller of the focus loop: from measurements to the offset of the focus.

Nothing here depends on anything but the last state and the present measurement: a loop that is started again
goes on where it was, and a recorded night gives the same offsets again.

The offset c is what the telescope is to take off: residual = disturbance − c. Within its linear range the
loop integrates with a leak, ``c ← (1 − leak) c + gain · m``. Beyond, it jumps by the whole measurement, by no
more than a limit, and waits until the jump shows in the frames.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

BOOTSTRAP, TRACKING = "bootstrap", "tracking"

# Why the offset was held although the measurement is valid.
SETTLING, OUTSIDE = "settling", "outside"

RESPONSES = np.array([1.0, 0.0, -1.0, 2.0])  # as it should be; none; the wrong sign; twice
WORDS = ("", "not answered", "answered with the wrong sign", "answered twice as much as commanded")
GAINS = np.array([0.2, 0.5, 0.9])  # of the forecast: as much noise as wander, and more or less of it
TREND_GAIN = 0.1  # gain of the forecast's slope over that of its level
DRIFT_NM = 2.0  # per exposure that a disturbance may drift; the focus of a telescope takes minutes for that
MEMORIES = np.array([40, 200])[:, None, None]  # exposures to average errors over: quick, and for much noise
FEWEST, LEAST_NM = 4, 5.0  # exposures before a verdict; error of a forecast below which none matters
DECISIVE = 15.0  # natural logarithm of the odds; in 135 simulated hours of closed loops it stays below 9


@dataclass(frozen=True)
class ControllerSettings:
    gain: float = 0.4  # per exposure
    leak: float = 0.0  # per exposure
    delay: int = 1  # whole exposures between the end of one and the offset that follows, see `Integrator`
    limit_nm: float = 1500.0  # largest offset either way; clipped there, and so is what is integrated
    jump_nm: float = 400.0  # largest change of the offset while the loop is outside its linear range
    capture_nm: float = 100.0  # residual below which the loop begins to integrate
    linear_nm: float = 200.0  # residual above which a measurement is not believed
    patience: int = 3  # measurements beyond that, one after the other, after which the loop starts again

    def __post_init__(self) -> None:
        for name in ("limit_nm", "jump_nm", "linear_nm"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} {getattr(self, name):g}: give a positive, finite number of nm RMS")
        if self.delay < 0 or self.patience < 1:
            raise ValueError(
                f"delay {self.delay}, patience {self.patience}: give exposures, from 0 and from 1 on"
            )
        largest = 2 * math.sin(math.pi / (2 * (2 * self.delay + 1)))
        if not 0 < self.gain < largest:
            raise ValueError(
                f"gain {self.gain:g}: with a delay of {self.delay} exposures a loop is stable between 0 and "
                f"{largest:.3f}"
            )
        if not 0 <= self.leak < 1:
            raise ValueError(f"leak {self.leak:g}: give a part per exposure, from 0 to below 1")
        if not 0 < self.capture_nm <= self.linear_nm:
            raise ValueError(
                f"capture_nm {self.capture_nm:g} is above linear_nm {self.linear_nm:g}, or not positive"
            )


@dataclass(frozen=True)
class ControllerState:
    offset_nm: float = 0.0  # commanded last [nm RMS]
    mode: str = BOOTSTRAP
    settling: int = 0  # exposures still to pass until the last jump shows
    outside: int = 0  # measurements beyond the linear range, one after the other


@dataclass(frozen=True)
class Decision:
    state: ControllerState  # with the offset to command
    commanded: bool  # whether the measurement changed the offset; else it is held
    clipped: bool = False  # whether the offset stands at its limit
    held: str = ""  # why a valid measurement was not used


def decide(state: ControllerState, defocus_nm: float | None, settings: ControllerSettings) -> Decision:
    """Take the next exposure into account: the `state` before it, by the `settings`.

    `defocus_nm` is a valid measurement of the residual [nm RMS]; None where there is none, and the offset is
    held.
    """
    waiting = replace(state, settling=max(0, state.settling - 1))
    if defocus_nm is None:
        return Decision(waiting, False)
    if state.settling:
        return Decision(waiting, False, held=SETTLING)
    if state.mode == BOOTSTRAP and abs(defocus_nm) > settings.capture_nm:
        step_nm = math.copysign(min(abs(defocus_nm), settings.jump_nm), defocus_nm)
        return _moved(replace(state, settling=settings.delay), state.offset_nm + step_nm, settings)
    if abs(defocus_nm) > settings.linear_nm:
        # a loop cannot leave its range at once; if it has, it starts again
        outside = state.outside + 1
        again = replace(state, mode=BOOTSTRAP, outside=0) if outside >= settings.patience else None
        return Decision(again or replace(state, outside=outside), False, held=OUTSIDE)
    unclipped_nm = (1 - settings.leak) * state.offset_nm + settings.gain * defocus_nm
    return _moved(replace(state, mode=TRACKING, outside=0), unclipped_nm, settings)


def _moved(state: ControllerState, unclipped_nm: float, settings: ControllerSettings) -> Decision:
    limit = settings.limit_nm
    offset_nm = min(max(unclipped_nm, -limit), limit)
    return Decision(replace(state, offset_nm=offset_nm), True, clipped=offset_nm != unclipped_nm)


class Response:
    """Compares what the loop measures with what it has commanded."""

    def __init__(self, delay: int):
        self._delay = delay
        self._offsets_nm: list[float] = []
        self._level = np.full((len(RESPONSES), len(GAINS)), np.nan)
        self._trend = np.zeros(self._level.shape)
        self._squares = np.zeros((len(MEMORIES), *self._level.shape))
        self._count = 0

    def verdict(self, measured_nm: float | None, offset_nm: float, passed: int = 1) -> str:
        """Return what is wrong with the response, or an empty string.

        `measured_nm` is a valid measurement of the residual, None where there is none; `offset_nm` was
        commanded before it; `passed` counts the exposures since the one before.
        """
        self._offsets_nm = (self._offsets_nm + [offset_nm] * min(passed, self._delay + 1))[-self._delay - 1 :]
        if measured_nm is None:
            return ""
        return self._compared(measured_nm + RESPONSES[:, None] * self._offsets_nm[0])

    def _compared(self, disturbance_nm: np.ndarray) -> str:
        if not self._count:
            self._level[:] = disturbance_nm
        error = disturbance_nm - self._level - self._trend
        self._level += self._trend + GAINS * error
        self._trend = np.clip(self._trend + TREND_GAIN * GAINS * error, -DRIFT_NM, DRIFT_NM)
        self._count += 1
        remembered = np.minimum(self._count, MEMORIES)
        self._squares += (error**2 - self._squares) / remembered
        if self._count < FEWEST:
            return ""
        variance = np.maximum(self._squares.min(axis=2), LEAST_NM**2)
        evidence = 0.5 * remembered[:, 0] * np.log(variance[:, :1] / variance)
        return WORDS[int(evidence.max(axis=0).argmax())] if evidence.max() > DECISIVE else ""
