"""Errors of the estimates of one ramp, from the arrays that a sample leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.paper.ramp_conditions.conditions import WAYS


@dataclass(frozen=True)
class RampErrors:
    """Errors of one way on one ramp.

    Attributes
    ----------
    rms_nm : float
        RMS of the estimated defocus against the introduced one and the NCPA given to the estimator.
    true_rms_nm, bias_nm : float
        RMS and mean of the estimated defocus minus the one there was in the frame.
    converged : float
        Part of the frames.
    mode_nm, sigma_nm, scatter_nm, true_scatter_nm, leak : ndarray, (modes,)
        Of every mode: RMS error against the one there was; median of the quoted error; scatter over the
        frames beside that which goes with the introduced defocus, of the estimate and of what there was;
        and how much of the introduced defocus goes into it. Defocus itself: 1 less.
    """

    rms_nm: float
    true_rms_nm: float
    bias_nm: float
    converged: float
    mode_nm: np.ndarray
    sigma_nm: np.ndarray
    scatter_nm: np.ndarray
    true_scatter_nm: np.ndarray
    leak: np.ndarray


def errors_of(found: Mapping[str, np.ndarray], condition: str, way: str) -> RampErrors:
    """Return the errors of a `way` under a `condition` from the arrays `found` by `estimate`."""
    modes, key = list(WAYS[way].modes), f"{condition}/{way}"
    focus, introduced_nm = modes.index(DEFOCUS), found["introduced_nm"]
    modes_nm = found[f"{key}/modes_nm"]
    true_nm = found[f"{condition}/true_nm"][:, [noll - 2 for noll in modes]]
    wrong_nm = modes_nm - true_nm
    slope, rest_nm = _line(introduced_nm, modes_nm)
    _, true_rest_nm = _line(introduced_nm, true_nm)
    given_nm = found[f"{key}/given_defocus_nm"]
    return RampErrors(
        _rms(modes_nm[:, focus] - given_nm - introduced_nm),
        _rms(wrong_nm[:, focus]),
        float(np.nanmean(wrong_nm[:, focus])),
        float(np.mean(found[f"{key}/converged"])),
        np.array([_rms(column) for column in wrong_nm.T]),
        np.nanmedian(found[f"{key}/sigma_nm"], axis=0),
        np.nanstd(rest_nm, axis=0),
        np.nanstd(true_rest_nm, axis=0),
        slope - np.array([noll == DEFOCUS for noll in modes]),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _line(introduced_nm: np.ndarray, modes_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope of every mode against the introduced defocus, (modes,), and what is left, (frames, modes)."""
    usable = np.isfinite(modes_nm).all(axis=1)
    slope, offset_nm = np.polyfit(introduced_nm[usable], modes_nm[usable], 1)
    return slope, modes_nm - np.outer(introduced_nm, slope) - offset_nm
