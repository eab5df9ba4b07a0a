"""Whether the focus answers the offsets: the loop is closed only if the residual falls by what is commanded.

A residual that stays while offsets add up may be a drift that the loop follows, or a loop that is open. What
tells them apart is prediction. If offsets are answered as they are meant to be, measurement plus offset is
the disturbance alone, which wanders and may drift slowly, and the next one is foretold best. If they are not
answered, the measurement by itself is; if they act the other way, measurement minus offset. The errors of the
forecasts are compared as variances, so that no noise need be known, and a loop at rest tells nothing.
"""

from __future__ import annotations

import numpy as np

RESPONSES = np.array([1.0, 0.0, -1.0, 2.0])  # as it should be; none; the wrong sign; twice
WORDS = ("", "not answered", "answered with the wrong sign", "answered twice as much as commanded")
GAINS = np.array([0.2, 0.5, 0.9])  # of the forecast: as much noise as wander, and more or less of it
TREND_GAIN = 0.1  # gain of the forecast's slope over that of its level
DRIFT_NM = 2.0  # per exposure that a disturbance may drift; the focus of a telescope takes minutes for that
MEMORIES = np.array([40, 200])[:, None, None]  # exposures to average errors over: quick, and for much noise
FEWEST, LEAST_NM = 4, 5.0  # exposures before a verdict; error of a forecast below which none matters
DECISIVE = 15.0  # natural logarithm of the odds; in 135 simulated hours of closed loops it stays below 9


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
