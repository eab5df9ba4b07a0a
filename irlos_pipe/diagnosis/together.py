"""What recordings of several stars and nights share, as a diagnosis states it."""

from __future__ import annotations

import numpy as np

from irlos_pipe.diagnosis.acceptance import Search, labels_in
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.effect_sizes import parameter_covariance
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.moments import Moments
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.sharing import Change, Together, sharing


def together(search: Search, fitter: Fitter, cube: Cube, moments: Moments, options: Options) -> Together:
    """Compare the moments in what was found.

    Parameters
    ----------
    search : Search
    fitter : Fitter
    cube : Cube
    moments : Moments
        Several.
    options : Options
    """
    fitted = search.final.fitted
    fitter = fitter.of(search.final.stack, fitted.views)
    found = [sharing(labels, fitted, fitter, cube, moments, options.sure) for labels in _groups(search)]
    return Together(moments, found, _changes(search, moments))


def _groups(search: Search) -> list[list[str]]:
    """Labels of every effect that was named; those of one kind of which a model has one are together."""
    fitted = search.final.fitted
    groups: dict[str, list[str]] = {}
    for label in labels_in(fitted, search.accepted):
        effect = fitted.effect(label)
        groups.setdefault(label if effect.repeatable else effect.name, []).append(label)
    return list(groups.values())


def _changes(search: Search, moments: Moments) -> list[Change]:
    """Changes from the mean of all moments, which images determine better than those from the common part."""
    final, drifts = search.final, search.final.fitted.problem.drifts
    columns = np.array([drifts[number] for number in moments.by_number])  # (moments, modes)
    covariance = parameter_covariance(final.stack, final.fitted)
    from_mean = np.eye(len(columns)) - 1 / len(columns)
    changes = from_mean @ final.fitted.x[0].numpy()[columns]
    of_modes = covariance[columns.T[:, :, None], columns.T[:, None, :]]  # (modes, moments, moments)
    variances = np.diagonal(from_mean @ of_modes @ from_mean.T, axis1=1, axis2=2).T
    names = [one.name for one in moments.by_number.values()]
    return [
        Change(name, _rms(change), float(np.sqrt(np.mean(variance))))
        for name, change, variance in zip(names, changes, variances, strict=True)
    ]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
