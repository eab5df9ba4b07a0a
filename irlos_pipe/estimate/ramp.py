"""A focus ramp: estimated against introduced defocus, and the errors of the focus stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from irlos_pipe.conventions.keys import DITTO, Number, key
from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.units import ONE_SIGMA
from irlos_pipe.effects import Effect
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.focus_stage import travel_direction

FEWEST, TOO_FEW = 3, "a ramp needs at least three estimates at two or more offsets"
MIN_OBSERVABILITY = 1e-6  # part of a column's power that the others do not explain, at least


@dataclass(frozen=True)
class Line:
    """The straight line of a ramp."""

    slope: Number = key(nan, "Estimated over introduced defocus, 1 is right, and its standard error.")
    slope_sigma: Number = key(nan, DITTO)
    offset_nm: Number = key(nan, "Estimated defocus where none is introduced, by the line.")
    # Errors of frames at one introduced defocus may be common to them: each offset counts once.
    offset_sigma_nm: Number = key(
        nan, "Its standard error, by the scatter about the line and, with NCPAs, by theirs."
    )
    rms_nm: Number = key(nan, "RMS of estimated minus introduced defocus.")
    residual_rms_nm: Number = key(nan, "RMS of the estimates about the line.")
    saw_tooth_nm: Number = key(  # fitted together with a line, which would else take a part of it
        nan,
        "Difference between offsets reached upwards and downwards, by hysteresis of the focus stage, and "
        "its standard error; NaN where only one direction occurs.",
    )
    saw_tooth_sigma_nm: Number = key(nan, DITTO)


@dataclass(frozen=True, kw_only=True)
class RampSummary(Line):
    """Straight line and scatter of a ramp; NaN is what the ramp does not determine."""

    freedom: float = nan  # degrees of freedom of the scatter from which slope and offset have their errors
    # Constant bias of the second part of the ramp against the first (the reference of the focus stage lost
    # between two runs), fitted in the same way; NaN when the ramp is declared as one part.
    part_bias_nm: float = nan
    part_bias_sigma_nm: float = nan
    offsets_nm: np.ndarray  # (offsets,), introduced defocus
    median_nm: np.ndarray  # (offsets,), of the estimates
    scatter_nm: np.ndarray  # (offsets,), 1σ of them, from the 16th and 84th percentile


def summarise(
    introduced_nm: np.ndarray, estimated_nm: np.ndarray, second_part: np.ndarray | None = None
) -> RampSummary:
    """Summarise a ramp whose frames (frames,) are in order of recording; failed estimates are NaN.

    The focus reference of a second run, where `second_part` is True, may differ from that of the first.
    Raises ValueError with fewer than three estimates or a single offset.
    """
    direction = travel_direction(introduced_nm)
    part = np.zeros(len(introduced_nm)) if second_part is None else np.asarray(second_part, float)
    good = np.isfinite(estimated_nm)
    introduced, estimated = introduced_nm[good], estimated_nm[good]
    if len(introduced) < FEWEST or np.ptp(introduced) == 0:
        raise ValueError(TOO_FEW)
    columns = np.stack([introduced, np.ones_like(introduced)], axis=1)
    (slope, offset), (slope_sigma, _) = _least_squares(columns, estimated)
    residual = estimated - slope * introduced - offset
    offsets = np.unique(introduced)
    lever = 1 + introduced.mean() ** 2 / introduced.var()
    groups = [estimated[introduced == value] for value in offsets]
    steps, errors = _steps(introduced, estimated, direction[good] / 2, part[good])
    return RampSummary(
        freedom=len(introduced) - 2,
        slope=float(slope),
        slope_sigma=float(slope_sigma),
        offset_nm=float(offset),
        offset_sigma_nm=float(np.sqrt(np.sum(residual**2) / (len(residual) - 2) * lever / len(offsets))),
        rms_nm=_rms(estimated - introduced),
        residual_rms_nm=_rms(residual),
        saw_tooth_nm=steps[0],
        saw_tooth_sigma_nm=errors[0],
        part_bias_nm=steps[1],
        part_bias_sigma_nm=errors[1],
        offsets_nm=offsets,
        median_nm=np.array([np.median(g) for g in groups]),
        scatter_nm=np.array([_half_width(g) for g in groups]),
    )


def summarise_one_offset(introduced_nm: np.ndarray, estimated_nm: np.ndarray) -> RampSummary:
    """Summarise frames (frames,) of one defocus that nobody knows; what needs several offsets is NaN.

    Failed estimates are NaN. Raises ValueError without any estimate.
    """
    estimated = estimated_nm[np.isfinite(estimated_nm)]
    if not len(estimated):
        raise ValueError("no frame could be estimated")
    mean = float(estimated.mean())
    return RampSummary(
        offset_nm=mean - float(introduced_nm[0]),
        residual_rms_nm=_rms(estimated - mean),
        offsets_nm=introduced_nm[:1],
        median_nm=np.array([np.median(estimated)]),
        scatter_nm=np.array([_half_width(estimated)]),
    )


def _steps(
    introduced: np.ndarray, estimated: np.ndarray, direction: np.ndarray, part: np.ndarray
) -> tuple[list[float], list[float]]:
    """Coefficients of direction and part, fitted jointly with slope and offset, and their standard errors.

    What the ramp does not determine is NaN: a column that does not vary, or one that the others make up.
    """
    both_ways = direction.min() < 0 < direction.max()
    known = direction != 0 if both_ways else np.full(len(direction), True)
    columns = np.stack([np.ones_like(introduced), introduced, direction * both_ways, part], axis=1)[known]
    varies = np.append(True, np.ptp(columns[:, 1:], axis=0) > 0)
    solution, sigma = np.full(4, np.nan), np.full(4, np.nan)
    if np.linalg.matrix_rank(columns[:, varies]) == varies.sum():
        solution[varies], sigma[varies] = _least_squares(columns[:, varies], estimated[known])
    return solution[2:].tolist(), sigma[2:].tolist()


def _least_squares(columns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solution and its standard errors from the residuals."""
    solution = np.linalg.lstsq(columns, values, rcond=None)[0]
    freedom = max(len(values) - len(solution), 1)
    variance = np.sum((values - columns @ solution) ** 2) / freedom
    return solution, np.sqrt(variance * np.diag(np.linalg.inv(columns.T @ columns)))


def _half_width(values: np.ndarray) -> float:
    """1σ of values, from their percentiles."""
    low, _, high = np.percentile(values, ONE_SIGMA)
    return (high - low) / 2


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True)
class FocusStage:
    """What the focus stage really introduced."""

    introduced_nm: np.ndarray  # (frames,)
    effects: dict[str, dict]  # public parameters of its errors, by effect
    sigma: dict[str, dict]  # standard errors of those that were estimated


def fit_focus_stage(
    effects: Sequence[Effect], commanded_nm: np.ndarray, estimated_nm: np.ndarray
) -> FocusStage:
    """Estimate the free errors by least squares: what is introduced is linear in all of them.

    The `effects` act on a ramp, whose defocus (frames,) is in order of recording; failed estimates are NaN.
    Raises ValueError if the ramp cannot separate the errors.
    """
    labels = labels_of(effects)
    base = _introduced_nm(effects, commanded_nm, None)
    free = [(e, i) for e, effect in enumerate(effects) for i in range(len(effect.parameters))]
    if not free:
        known = {label: effect.describe(np.zeros(0)) for label, effect in zip(labels, effects, strict=True)}
        return FocusStage(base, known, {})
    columns = np.array([_introduced_nm(effects, commanded_nm, one) - base for one in free])
    values, sigma = _determined(columns, estimated_nm - base, [labels[e] for e, _ in free])
    found, errors = {}, {}
    for number, effect in enumerate(effects):
        own = [k for k, (e, _) in enumerate(free) if e == number]
        found[labels[number]] = effect.describe(values[own])
        errors[labels[number]] = {p.name: sigma[k] for p, k in zip(effect.parameters, own, strict=True)}
    return FocusStage(base + values @ columns, found, errors)


def _introduced_nm(effects, commanded_nm: np.ndarray, unit: tuple[int, int] | None) -> np.ndarray:
    """Introduced defocus with the fixed errors, and with a unit of one free parameter."""
    introduced = torch.as_tensor(np.asarray(commanded_nm, float))
    for number, effect in enumerate(effects):
        values = torch.zeros(len(effect.parameters), dtype=torch.float64)
        if unit is not None and unit[0] == number:
            values[unit[1]] = 1.0
        introduced = effect.apply(values, introduced, np.asarray(commanded_nm, float))
    return introduced.numpy()


def _determined(
    columns: np.ndarray, data_nm: np.ndarray, names: Sequence[str]
) -> tuple[np.ndarray, list[float]]:
    """Values of the columns and their standard errors from the residuals."""
    good = np.isfinite(data_nm)
    design, data = columns[:, good].T, data_nm[good]
    scale = np.linalg.norm(design, axis=0)
    if not scale.all() or np.linalg.svd(design / scale, compute_uv=False)[-1] ** 2 < MIN_OBSERVABILITY:
        raise ValueError(f"it does not determine {', '.join(sorted(set(names)))}; fix or remove one")
    values, sigma = _least_squares(design, data)
    return values, sigma.tolist()
