"""Change of the wavefront during a recording, from the estimates of single frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.effects import Effect, FixedEffect


def drifts(effect: Effect) -> bool:
    """Whether the effect is a change with time that is still to be estimated."""
    return effect.plane == "time" and len(effect.parameters) > 0


def measured_drift(effect: Effect, nolls: Sequence[int], frames_nm: np.ndarray) -> FixedEffect:
    """The effect held at the slopes of straight lines through the estimates of the frames.

    The mean image shows a drift to second order only, and not its sign; the frames show both.

    Parameters
    ----------
    effect : NcpaDrift, or it FixedEffect with all parameters free
    nolls : sequence of int
        Modes of `frames_nm`.
    frames_nm : ndarray, (frames, modes)
        At equal intervals of time.

    Raises
    ------
    ValueError
        If a mode that is to drift is not estimated.
    """
    base = effect.base
    missing = sorted(set(base.nolls) - set(nolls))
    if missing:
        raise ValueError(f"ncpa_drift of Noll {missing}: only modes that are estimated can drift")
    when = np.linspace(-0.5, 0.5, len(frames_nm))
    columns = [list(nolls).index(noll) for noll in base.nolls]
    return FixedEffect(base, when @ frames_nm[:, columns] / (when @ when))
