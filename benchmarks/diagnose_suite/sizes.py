"""Whether a size is right, and how large it is for what can be seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.diagnose_suite.judging import Outcome, is_first
from irlos_pipe.conventions.bands import NARROW_H

CONFIDENCE = 0.95
NEGLIGIBLE = 1e-9  # a component of a direction that is zero but for rounding
PETAL_KINDS = ("piston_nm", "tip_nm", "tilt_nm")  # of which the mean belongs to the whole pupil


def true_size_inside(outcome: Outcome) -> bool | None:
    """Whether the true size lies in the quoted 95 % interval; None if nothing was quoted.

    Of an effect with several sizes (modes, petals), ``Σ ((found − true)/σ)²`` is compared with the 95 %
    point of χ²; errors of different sizes are taken as independent.
    """
    (effect,) = outcome["truth"]["effects"]
    step = next((one for one in outcome["diagnosis"]["steps"] if one["effect"] == effect), None)
    if step is None or not is_first(outcome):
        return None
    truth = outcome["truth"]["sizes"][effect]
    if effect == "bad_pixels":
        return sorted(map(list, step["parameters"]["pixels"])) == sorted(truth["pixels"])
    found, true, sigma = _aligned(step, truth)
    if not np.all(np.isfinite(sigma)) or not np.all(sigma > 0):
        return False
    return bool(np.sum(((found - true) / sigma) ** 2) <= stats.chi2.ppf(CONFIDENCE, len(true)))


def _aligned(step: Mapping[str, Any], truth: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Found sizes, true ones and standard errors in one order; modes that one of them lacks are zero."""
    rows = []
    for key, value in truth.items():
        found, true = _leaves(key, step["parameters"].get(key)), _leaves(key, value)
        sigma = _leaves("", step["sigma"].get(key))
        rows += [(found.get(at, 0.0), true.get(at, 0.0), sigma.get(at, np.nan)) for at in {**true, **found}]
    return tuple(np.array(rows, float).T)


def _leaves(key: str, value: Any) -> dict[str, float]:
    """Numbers by their place in a public value; petals without their mean."""
    if value is None:
        return {}
    if isinstance(value, Mapping):
        return {str(place): _number(one) for place, one in value.items()}
    if isinstance(value, list):
        mean = np.mean([_number(one) for one in value]) if key in PETAL_KINDS else 0.0
        return {str(place): _number(one) - mean for place, one in enumerate(value)}
    return {"": _number(value)}


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def in_smallest(outcome: Outcome, smallest: Mapping[str, Any]) -> float:
    """Size of the hidden effect over its smallest detectable one (MDB); NaN where that is not known.

    ``sqrt(Σ (size / MDB)²)`` over modes or petals: the root of the expected gain of χ² over that at which
    an effect counts as seen.
    """
    (effect,) = outcome["truth"]["effects"]
    truth, mdb = outcome["truth"]["sizes"].get(effect, {}), smallest.get(effect, {})
    ratios = [
        _amount(key, number) / smallest_one
        for key in truth.keys() & mdb.keys()
        for place, number in _leaves(key, truth[key]).items()
        if (smallest_one := abs(_leaves("", mdb[key]).get(place, 0.0))) > NEGLIGIBLE
    ]
    return float(np.linalg.norm(ratios)) if ratios else float("nan")


def _amount(key: str, number: float) -> float:
    """How far a public value is from absence."""
    return number - NARROW_H.centre_nm if key == "wavelength_nm" else number
