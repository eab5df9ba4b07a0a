"""Statistics of a loop over all its runs: residual, bias, losses, and how well its sensor measured."""

from __future__ import annotations

import math

import numpy as np

from irlos_pipe.control.disturbance import Drift
from irlos_pipe.product.results import Number, ResultsPart

MIN_FOR_A_SLOPE = 20


class LoopOutcome(ResultsPart):
    """Statistics of one loop.

    Attributes
    ----------
    residual_nm, residual_error_nm : float
        RMS over time and over the runs that did not diverge, what wanders within a frame included, and
        its standard error from the scatter between runs.
    bias_nm : float
        RMS over skies of the mean residual.
    lost : float
        Part of the measurements that LIFT could not give.
    diverged, runs : int
    slope, noise_nm : float
        Measurement = slope × true residual + noise; NaN with few measurements.
    """

    residual_nm: Number = math.nan
    residual_error_nm: Number = math.nan
    bias_nm: Number = math.nan
    lost: Number = math.nan
    diverged: int = 0
    runs: int = 0
    slope: Number = math.nan
    noise_nm: Number = math.nan


def outcome_of(
    residual_nm: np.ndarray,
    measured_nm: np.ndarray,
    true_nm: np.ndarray,
    due: np.ndarray,
    drift: Drift,
    settle: int,
) -> LoopOutcome:
    """Summarise one loop.

    Parameters
    ----------
    residual_nm, measured_nm, true_nm, due : ndarray, (skies, drifts, frames)
        See `LoopRecord`.
    drift : Drift
        Of which a part wanders within a frame.
    settle : int
        Frames left out at the beginning.
    """
    late = residual_nm[..., settle:]
    alive = np.isfinite(late).all(-1)
    squares = np.mean(late[alive] ** 2, axis=-1) + drift.wander_within_nm2(1.0)
    runs = len(squares)
    rms = float(np.sqrt(squares.mean())) if runs else math.nan
    error = float(np.std(squares, ddof=1) / np.sqrt(runs) / (2 * rms)) if runs > 1 else math.nan
    slope, noise = sensor_of(measured_nm, true_nm)
    return LoopOutcome(
        residual_nm=rms,
        residual_error_nm=error,
        bias_nm=_bias_nm(late, alive),
        lost=float(np.mean(~np.isfinite(measured_nm[due]))),
        diverged=int((~alive).sum()),
        runs=alive.size,
        slope=slope,
        noise_nm=noise,
    )


def _bias_nm(residual_nm: np.ndarray, alive: np.ndarray) -> float:
    means = [sky[fine].mean() for sky, fine in zip(residual_nm, alive, strict=True) if fine.any()]
    return float(np.sqrt(np.mean(np.square(means)))) if means else math.nan


def sensor_of(measured_nm: np.ndarray, true_nm: np.ndarray) -> tuple[float, float]:
    """Return the slope of measurement against truth, and the RMS about it.

    Every sky has an offset of its own.

    Parameters
    ----------
    measured_nm, true_nm : ndarray, (skies, drifts, frames)
        NaN where there is no measurement. Noise enters the truth only of later frames, so that a plain
        regression is unbiased.
    """
    pairs = [_centred(m, t) for m, t in zip(measured_nm, true_nm, strict=True)]
    m, t = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    if len(m) < MIN_FOR_A_SLOPE:
        return math.nan, math.nan
    slope = float(m @ t / (t @ t))
    return slope, float(np.sqrt(np.sum((m - slope * t) ** 2) / (len(m) - len(pairs) - 1)))


def _centred(measured_nm: np.ndarray, true_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of one sky less their means."""
    given = np.isfinite(measured_nm) & np.isfinite(true_nm)
    m, t = measured_nm[given], true_nm[given]
    return (m - m.mean(), t - t.mean()) if len(m) else (m, t)
