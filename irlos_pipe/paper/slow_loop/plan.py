"""Which loops are worth running: each star at the gain that theory calls best, and a scan of gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from irlos_pipe.paper.slow_loop.closed import Loop
from irlos_pipe.paper.slow_loop.control import best_gain
from irlos_pipe.paper.slow_loop.disturbance import Drift

Noise = Callable[[float, int], float]
"""Noise of a measurement [nm RMS] of a star of some magnitude, from a number of one-second frames."""


def at_best_gain(
    sensor: str, magnitudes: Sequence[float], drift: Drift, delay: int, noise: Noise, exposures: int = 1
) -> list[Loop]:
    """One loop per star, at the gain with the smallest predicted residual."""
    return [
        Loop(
            sensor,
            mag_j,
            round(best_gain(drift, noise(mag_j, exposures), float(exposures), delay), 3),
            exposures,
        )
        for mag_j in magnitudes
    ]


def gain_scan(sensor: str, magnitudes: Sequence[float], gains: Sequence[float]) -> list[Loop]:
    """Every gain on every star."""
    return [Loop(sensor, mag_j, gain) for mag_j in magnitudes for gain in gains]
