"""Standard error of a mean over correlated frames."""

from __future__ import annotations

import numpy as np


def autocorrelation_time(series: np.ndarray) -> np.ndarray:
    """Integrated autocorrelation time of every column, in frames.

    ``τ = 1 + 2 Σ ρ(l)``, summed in pairs of lags until a pair is no longer positive
    (initial positive sequence, Geyer 1992, Stat. Sci. 7, 473); at least 1.

    Parameters
    ----------
    series : ndarray, (frames, columns)

    Returns
    -------
    ndarray, (columns,)
    """
    frames = len(series)
    if frames < 4:
        return np.ones(series.shape[1])
    centred = series - series.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centred, n=2 * frames, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:frames]
    rho = covariance / np.where(covariance[0] > 0, covariance[0], 1)
    pairs = rho[1:-1:2][: frames // 4] + rho[2::2][: frames // 4]
    positive = np.cumprod(pairs > 0, axis=0)
    return np.maximum(1 + 2 * np.sum(pairs * positive, axis=0), 1)


def covariance_of_mean(series: np.ndarray) -> np.ndarray:
    """Covariance of the mean of correlated rows, (columns, columns).

    The sample covariance over N, each column's error inflated by the root of its
    autocorrelation time.

    Raises
    ------
    ValueError
        With fewer than two rows.
    """
    if len(series) < 2:
        raise ValueError("the scatter of a mean needs at least two frames")
    inflation = np.sqrt(autocorrelation_time(series))
    covariance = np.atleast_2d(np.cov(series, rowvar=False)) / len(series)
    return covariance * inflation[:, None] * inflation[None, :]
