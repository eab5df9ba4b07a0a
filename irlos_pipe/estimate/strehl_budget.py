"""Strehl budget: what every part of a model does to the peak of the image, alone and beside all others."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.effects import Effect, fixed_optics
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

ALL = "all together"


@dataclass(frozen=True)
class StrehlPart:
    """One part of a model.

    Attributes
    ----------
    name : str
        Of the modes or the effect; `ALL` for the whole model.
    alone, without : float
        Strehl ratio with nothing else in the model, and with all else but this.
    wfe_nm : float
        RMS of its modes; NaN of an effect.
    """

    name: str
    alone: float
    without: float
    wfe_nm: float = math.nan


def strehl_budget(
    settings: PsfSettings,
    nolls: Sequence[int],
    modes_nm: Mapping[str, np.ndarray],
    effects: Mapping[str, Effect],
) -> list[StrehlPart]:
    """Return the budget, the whole model first.

    The Strehl ratio is the brightest pixel over that of the image without aberrations. Small parts multiply,
    ``S ≈ exp(-(2π σ/λ)²)`` each; larger ones interfere, so that the product is not that of all together.

    Parameters
    ----------
    settings : PsfSettings
        Diversity and introduced defocus in it are left out.
    nolls : sequence of int
    modes_nm : mapping of str to ndarray, (modes,)
        Parts of the wavefront by name, zero in the modes of the others.
    effects : mapping of str to Effect
        With all parameters held.
    """
    model = light_path(replace(settings, known=KnownWavefront()), nolls)
    nothing = np.zeros(len(nolls))
    peak = _peak(model, nothing, [])

    def strehl(names: Sequence[str]) -> float:
        wavefront = sum((modes_nm[name] for name in names if name in modes_nm), nothing)
        return _peak(model, wavefront, [effects[name] for name in names if name in effects]) / peak

    every = [*modes_nm, *effects]
    parts = [StrehlPart(ALL, strehl(every), 1.0, float(np.linalg.norm(sum(modes_nm.values(), nothing))))]
    for name in every:
        wfe_nm = float(np.linalg.norm(modes_nm[name])) if name in modes_nm else math.nan
        others = [other for other in every if other != name]
        parts.append(StrehlPart(name, strehl([name]), strehl(others), wfe_nm))
    return parts


def _peak(model: LightPath, modes_nm: np.ndarray, effects: Sequence[Effect]) -> float:
    """Brightest pixel of a unit-flux image."""
    optics = fixed_optics(list(effects), model.grids)
    return float(model.images(torch.as_tensor(modes_nm)[None], optics).max())
