"""How far the focus stage misses what it is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

REST_NM = 0.0  # where the stage stands before the first move


def reached_nm(
    told_nm: Sequence[float] | np.ndarray, effects: Mapping[str, Mapping], rng: np.random.Generator
) -> np.ndarray:
    """Defocus that the stage introduces, (positions,) [nm RMS].

    ``reached = (1 + fraction) told + direction · nm + scatter + bias``

    Parameters
    ----------
    told_nm : sequence of float
        In the order of time.
    effects : mapping
        `focus_stage_scale`: `fraction`. `focus_stage_offset`: bias `nm` of positions larger than
        `above_nm` and smaller than `below_nm`. `focus_stage_hysteresis`: `nm` after moving towards
        larger positions, its opposite otherwise; `scatter_nm` RMS drawn for every move; `direction`
        (+1 or -1) of the move that led to the first position, if it was not from 0.
    """
    told = np.asarray(told_nm, float)
    scale = effects.get("focus_stage_scale", {}).get("fraction", 0.0)
    return (
        told * (1 + scale)
        + _hysteresis_nm(told, effects.get("focus_stage_hysteresis", {}), rng)
        + _bias_nm(told, effects.get("focus_stage_offset", {}))
    )


def travel_directions(told_nm: np.ndarray, first: float | None = None) -> np.ndarray:
    """Direction of the last move, +1 towards larger positions; a stage that stays keeps it.

    Parameters
    ----------
    first : float, optional
        Of the move before the first position; by default the stage comes from `REST_NM`.

    Returns
    -------
    ndarray, (positions,)
        0 before the first move.
    """
    moves = np.diff(told_nm, prepend=REST_NM)
    directions, last = [], 0.0
    for index, move in enumerate(moves):
        last = first if index == 0 and first is not None else float(np.sign(move)) or last
        directions.append(last)
    return np.array(directions)


def _hysteresis_nm(told_nm: np.ndarray, effect: Mapping[str, float], rng: np.random.Generator) -> np.ndarray:
    if not effect:
        return np.zeros_like(told_nm)
    moves = np.cumsum(np.diff(told_nm, prepend=told_nm[0]) != 0)
    scatter_nm = effect.get("scatter_nm", 0.0) * rng.standard_normal(moves[-1] + 1)[moves]
    return travel_directions(told_nm, effect.get("direction")) * effect["nm"] + scatter_nm


def _bias_nm(told_nm: np.ndarray, effect: Mapping[str, float]) -> np.ndarray:
    concerned = (told_nm > effect.get("above_nm", -np.inf)) & (told_nm < effect.get("below_nm", np.inf))
    return np.where(concerned, effect.get("nm", 0.0), 0.0)
