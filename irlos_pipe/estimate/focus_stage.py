"""Errors of the focus stage from the estimates of a ramp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects import Effect

LEAST_SURVIVAL = 1e-6  # of a column's power beside the others


@dataclass(frozen=True)
class FocusStage:
    """What the focus stage really introduced.

    Attributes
    ----------
    introduced_nm : ndarray, (frames,)
    effects, sigma : dict
        Public parameters of its errors, and standard errors of those that were estimated, by effect.
    """

    introduced_nm: np.ndarray
    effects: dict[str, dict]
    sigma: dict[str, dict]


def fit_focus_stage(
    effects: Sequence[Effect], commanded_nm: np.ndarray, estimated_nm: np.ndarray
) -> FocusStage:
    """Estimate the free errors by least squares: what is introduced is linear in all of them.

    Parameters
    ----------
    effects : sequence of Effect
        That act on a ramp.
    commanded_nm, estimated_nm : ndarray, (frames,)
        In order of recording; failed estimates are NaN.

    Raises
    ------
    ValueError
        If the ramp cannot tell the errors apart.
    """
    base = _introduced_nm(effects, commanded_nm, None)
    free = [(e, i) for e, effect in enumerate(effects) for i in range(len(effect.parameters))]
    if not free:
        return FocusStage(base, {effect.name: effect.describe(()) for effect in effects}, {})
    columns = np.array([_introduced_nm(effects, commanded_nm, one) - base for one in free])
    values, sigma = _least_squares(columns, estimated_nm - base, [effects[e].name for e, _ in free])
    told, errors = {}, {}
    for number, effect in enumerate(effects):
        own = [k for k, (e, _) in enumerate(free) if e == number]
        told[effect.name] = effect.describe(values[own])
        errors[effect.name] = {p.name: sigma[k] for p, k in zip(effect.parameters, own, strict=True)}
    return FocusStage(base + values @ columns, told, errors)


def _introduced_nm(effects, commanded_nm: np.ndarray, unit: tuple[int, int] | None) -> np.ndarray:
    """Introduced defocus with the fixed errors, and with a unit of one free parameter."""
    introduced = torch.as_tensor(np.asarray(commanded_nm, float))
    for number, effect in enumerate(effects):
        values = torch.zeros(len(effect.parameters), dtype=torch.float64)
        if unit is not None and unit[0] == number:
            values[unit[1]] = 1.0
        introduced = effect.apply(values, introduced, np.asarray(commanded_nm, float))
    return introduced.numpy()


def _least_squares(
    columns: np.ndarray, data_nm: np.ndarray, names: Sequence[str]
) -> tuple[np.ndarray, list[float]]:
    """Values of the columns and their standard errors from the residuals."""
    good = np.isfinite(data_nm)
    design, data = columns[:, good].T, data_nm[good]
    scale = np.linalg.norm(design, axis=0)
    if not scale.all() or np.linalg.svd(design / scale, compute_uv=False)[-1] ** 2 < LEAST_SURVIVAL:
        raise ValueError(f"it does not determine {', '.join(sorted(set(names)))}; fix or remove one")
    values = np.linalg.lstsq(design, data, rcond=None)[0]
    residual = data - design @ values
    variance = residual @ residual / max(len(data) - len(values), 1)
    return values, np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design))).tolist()
