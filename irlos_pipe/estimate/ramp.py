"""What a focus ramp says: estimated against introduced defocus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RampSummary:
    """Straight line and scatter of a ramp.

    Attributes
    ----------
    slope, slope_sigma : float
    offset_nm : float
    rms_nm : float
        RMS of estimated minus introduced defocus.
    residual_rms_nm : float
        RMS about the straight line.
    saw_tooth_nm, saw_tooth_sigma_nm : float
        Difference between offsets reached upwards and downwards (hysteresis of the focus stage), fitted
        together with a line, which would else take a part of it; NaN when only one direction occurs.
    offsets_nm, median_nm, scatter_nm : ndarray, (offsets,)
        Introduced defocus, and the median and 1σ (from the 16th and 84th percentile) of the estimates.
    """

    slope: float
    slope_sigma: float
    offset_nm: float
    rms_nm: float
    residual_rms_nm: float
    saw_tooth_nm: float
    saw_tooth_sigma_nm: float
    offsets_nm: np.ndarray
    median_nm: np.ndarray
    scatter_nm: np.ndarray


def travel_direction(introduced_nm: np.ndarray) -> np.ndarray:
    """+1 or -1 for values reached by a rise or fall of the introduced defocus, in order of recording.

    Frames at an unchanged offset keep the direction in which it was reached; 0 before the first move.
    """
    moves = np.sign(np.diff(introduced_nm, prepend=introduced_nm[:1]))
    last_move = np.maximum.accumulate(np.where(moves != 0, np.arange(len(moves)), 0))
    return moves[last_move]


def summarise(introduced_nm: np.ndarray, estimated_nm: np.ndarray) -> RampSummary:
    """Summary of a ramp whose frames are in order of recording; failed estimates are NaN.

    Raises
    ------
    ValueError
        With fewer than three estimates or a single offset.
    """
    direction = travel_direction(introduced_nm)
    good = np.isfinite(estimated_nm)
    introduced, estimated, direction = introduced_nm[good], estimated_nm[good], direction[good]
    if len(introduced) < 3 or np.ptp(introduced) == 0:
        raise ValueError("a ramp needs at least three estimates at two or more offsets")
    (slope, offset), covariance = _line(introduced, estimated)
    residual = estimated - slope * introduced - offset
    offsets = np.unique(introduced)
    groups = [estimated[introduced == value] for value in offsets]
    return RampSummary(
        slope,
        covariance,
        offset,
        _rms(estimated - introduced),
        _rms(residual),
        *_saw_tooth(introduced, estimated, direction),
        offsets,
        np.array([np.median(g) for g in groups]),
        np.array([np.diff(np.percentile(g, [15.87, 84.13]))[0] / 2 for g in groups]),
    )


def _line(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], float]:
    """Slope and offset, and the slope's standard error from the residuals."""
    slope, offset = np.polyfit(x, y, 1)
    freedom = max(len(x) - 2, 1)
    sigma = np.sqrt(np.sum((y - slope * x - offset) ** 2) / freedom / np.sum((x - x.mean()) ** 2))
    return (float(slope), float(offset)), float(sigma)


def _saw_tooth(introduced: np.ndarray, estimated: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
    """Twice the coefficient of the direction beside slope and offset, and its standard error."""
    moved = direction != 0
    columns = np.stack([introduced, np.ones_like(introduced), direction], axis=1)[moved]
    solution, _, rank, _ = np.linalg.lstsq(columns, estimated[moved], rcond=None)
    if rank < 3:
        return float("nan"), float("nan")
    residual = estimated[moved] - columns @ solution
    variance = np.sum(residual**2) / max(len(residual) - 3, 1) * np.linalg.inv(columns.T @ columns)[2, 2]
    return float(2 * solution[2]), float(2 * np.sqrt(variance))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
