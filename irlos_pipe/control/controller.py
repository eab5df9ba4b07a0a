"""The controller of the focus loop: from measurements to the offset of the focus.

Nothing here depends on anything but the last state and the present measurement: a loop that is started again
goes on where it was, and a recorded night gives the same offsets again.

The offset c is what the telescope is to take off: residual = disturbance − c. Within its linear range the
loop integrates with a leak, ``c ← (1 − leak) c + gain · m``. Beyond, it jumps by the whole measurement, by no
more than a limit, and waits until the jump shows in the frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

BOOTSTRAP, TRACKING = "bootstrap", "tracking"

# Why the offset was held although the measurement is valid.
SETTLING, OUTSIDE = "settling", "outside"


@dataclass(frozen=True)
class ControllerSettings:
    """Constants of the controller."""

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
    """All that the controller remembers."""

    offset_nm: float = 0.0  # commanded last [nm RMS]
    mode: str = BOOTSTRAP
    settling: int = 0  # exposures still to pass until the last jump shows
    outside: int = 0  # measurements beyond the linear range, one after the other


@dataclass(frozen=True)
class Decision:
    """What the controller made of an exposure."""

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
        return _jump(state, defocus_nm, settings)
    if abs(defocus_nm) > settings.linear_nm:
        return _doubt(state, settings)
    unclipped_nm = (1 - settings.leak) * state.offset_nm + settings.gain * defocus_nm
    return _moved(replace(state, mode=TRACKING, outside=0), unclipped_nm, settings)


def _jump(state: ControllerState, defocus_nm: float, settings: ControllerSettings) -> Decision:
    step_nm = math.copysign(min(abs(defocus_nm), settings.jump_nm), defocus_nm)
    return _moved(replace(state, settling=settings.delay), state.offset_nm + step_nm, settings)


def _doubt(state: ControllerState, settings: ControllerSettings) -> Decision:
    """A loop cannot leave its range at once; if it has, it starts again."""
    outside = state.outside + 1
    if outside < settings.patience:
        return Decision(replace(state, outside=outside), False, held=OUTSIDE)
    return Decision(replace(state, mode=BOOTSTRAP, outside=0), False, held=OUTSIDE)


def _moved(state: ControllerState, unclipped_nm: float, settings: ControllerSettings) -> Decision:
    limit = settings.limit_nm
    offset_nm = min(max(unclipped_nm, -limit), limit)
    return Decision(replace(state, offset_nm=offset_nm), True, clipped=offset_nm != unclipped_nm)
