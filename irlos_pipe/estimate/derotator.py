"""What of the NCPAs turns with the derotator, and what does not.

A cube at derotator angle α shows ``z(α) = f + M(sα) r``: f arises behind the derotator, r before it
and is turned by `optics.zernike.rotation_matrix`, s = ±1 is the sense. This is linear in f and r,
and each (n, |m|) is a problem of its own. Rotationally symmetric modes show f + r at every angle,
so only their sum is measured; tip and tilt are where the star lies, and left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.keys import Number, key
from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.optics.zernike import noll_to_nm, partner, rotation_matrix

MIN_SPREAD = 0.01  # 1 − |mean of exp(imα)|²; below it the parts' errors exceed tenfold that of the sum


@dataclass(frozen=True)
class Series:
    """Estimates at several derotator angles."""

    nolls: tuple[int, ...]
    angles_deg: np.ndarray  # (cubes,), by which the wavefront before the derotator is turned
    zernike_nm: np.ndarray  # (cubes, modes)
    covariance_nm2: np.ndarray  # (cubes, modes, modes)

    @property
    def sigma_nm(self) -> np.ndarray:
        """Standard errors, (cubes, modes)."""
        return np.sqrt(np.diagonal(self.covariance_nm2, axis1=1, axis2=2))

    def only(self, keep: np.ndarray) -> Series:
        """Return those modes for which `keep`, (modes,) of bool, is true."""
        nolls = tuple(noll for noll, kept in zip(self.nolls, keep, strict=True) if kept)
        covariance_nm2 = self.covariance_nm2[:, keep][:, :, keep]
        return replace(self, nolls=nolls, zernike_nm=self.zernike_nm[:, keep], covariance_nm2=covariance_nm2)

    def turned_back(self, sense: int) -> Series:
        """Return every estimate in the frame before the derotator, errors included."""
        back = np.array([rotation_matrix(self.nolls, -sense * angle) for angle in self.angles_deg])
        turned_nm = np.einsum("cij,cj->ci", back, self.zernike_nm)
        return replace(self, zernike_nm=turned_nm, covariance_nm2=back @ self.covariance_nm2 @ back.mT)


@dataclass(frozen=True)
class Part:
    """Coefficients with their covariance; zero for modes that are not of this part."""

    zernike_nm: np.ndarray  # (modes,)
    # (modes, modes), of modes of the same (n, |m|); others are taken as independent
    covariance_nm2: np.ndarray

    @property
    def sigma_nm(self) -> np.ndarray:
        """Standard errors, (modes,)."""
        return np.sqrt(np.diag(self.covariance_nm2))

    @property
    def rms_nm(self) -> float:
        """RMS over the disc; it holds the noise too."""
        return float(np.sqrt(np.sum(self.zernike_nm**2)))

    @property
    def noise_nm(self) -> float:
        """What the RMS of a vanishing part would be."""
        return float(np.sqrt(np.trace(self.covariance_nm2)))


@dataclass(frozen=True)
class Split:
    """The parts of a series."""

    nolls: tuple[int, ...]
    separable: np.ndarray  # (modes,), which ones the angles separate
    rotating: Part  # of separable modes, in the frame before the derotator, that of angle 0
    fixed: Part  # of separable modes
    unsplit: Part  # sum of both in the other modes: symmetric ones, and those that are not separable
    predicted_nm: np.ndarray  # (cubes, modes)
    chi2: float  # against the errors of the single estimates
    freedom: int
    sense: int  # +1: the rotating part turns anticlockwise with the angle

    @property
    def chi2_nu(self) -> float:
        """Reduced χ²; NaN without degrees of freedom."""
        return self.chi2 / self.freedom if self.freedom else float("nan")


def usable_modes(nolls: Sequence[int], highest_noll: int | None = None) -> np.ndarray:
    """Whether `nolls` up to `highest_noll` can be rotated, (modes,): not tip, tilt, nor without a partner."""
    among = {noll for noll in nolls if noll not in TIP_TILT and noll <= (highest_noll or noll)}
    return np.array([noll in among and partner(noll) in among for noll in nolls])


def split_series(series: Series, sense: int) -> Split:
    """Separate the part that turns with the derotator from the part that does not.

    The `series` is without tip and tilt, every (n, |m|) complete, see `usable_modes`; the `sense` is 1 or -1.
    Raises ValueError when a partner is missing.
    """
    modes = len(series.nolls)
    turns = np.array([rotation_matrix(series.nolls, sense * angle) for angle in series.angles_deg])
    # whether the angles are spread enough for the azimuthal order m of a mode: with equal errors σ in K cubes
    # each part's variance is ``σ²/K/(1 − |⟨exp(imα)⟩|²)``
    m = np.array([noll_to_nm(noll)[1] for noll in series.nolls])
    phases = [np.exp(1j * one * np.radians(series.angles_deg)) for one in m]
    separable = np.array([1 - abs(one.mean()) ** 2 > MIN_SPREAD for one in phases])
    values, covariances = np.zeros((3, modes)), np.zeros((3, modes, modes))
    for pair in _pairs(series.nolls):
        # numbers of the parts (rotating, fixed, unsplit) and their design, (cubes, modes, unknowns)
        turned = turns[:, pair][:, :, pair]
        unturned = np.broadcast_to(np.eye(len(pair)), turned.shape)
        parts, design = [2], unturned
        if separable[pair[0]]:
            parts, design = [0, 1], np.concatenate([turned, unturned], axis=2)
        value, covariance = _least_squares(design, series, pair)
        for place, part in enumerate(parts):
            own = slice(place * len(pair), (place + 1) * len(pair))
            values[part, pair] = value[own]
            covariances[part][np.ix_(pair, pair)] = covariance[own, own]
    rotating, fixed, unsplit = (Part(v, c) for v, c in zip(values, covariances, strict=True))
    predicted = np.einsum("cij,j->ci", turns, rotating.zernike_nm) + fixed.zernike_nm + unsplit.zernike_nm
    pulls = (series.zernike_nm - predicted) / series.sigma_nm
    freedom = pulls.size - modes - int(separable.sum())
    return Split(
        series.nolls, separable, rotating, fixed, unsplit, predicted, float(np.sum(pulls**2)), freedom, sense
    )


def _pairs(nolls: Sequence[int]) -> Iterator[list[int]]:
    """Places of the modes of each (n, |m|)."""
    for place, noll in enumerate(nolls):
        if partner(noll) >= noll:
            yield sorted({place, list(nolls).index(partner(noll))})


def _least_squares(design: np.ndarray, series: Series, pair: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns and covariance, weighted by the variances.

    A covariance from a few frames may be singular, so correlations enter the propagated errors only.
    """
    covariance = series.covariance_nm2[:, pair][:, :, pair]
    weighted = design / np.diagonal(covariance, axis1=1, axis2=2)[:, :, None]
    normal = np.einsum("cmu,cmv->uv", weighted, design)
    gain = np.linalg.solve(normal, np.moveaxis(weighted, 2, 0).reshape(len(normal), -1))
    gain = gain.reshape(len(normal), len(design), len(pair))
    value = np.einsum("ucm,cm->u", gain, series.zernike_nm[:, pair])
    return value, np.einsum("ucm,cmn,vcn->uv", gain, covariance, gain)


def try_both_senses(series: Series) -> list[Split]:
    """Split with either sense, the better one first; at a tie the wavefront turns anticlockwise."""
    return sorted((split_series(series, sense) for sense in (1, -1)), key=lambda split: split.chi2)


@dataclass(frozen=True)
class Consistency:
    """Mean RMS difference between the estimates of two angles [nm]."""

    measured_nm: Number = key(math.nan, "As measured: small if nothing turned.")
    turned_back_nm: Number = key(math.nan, "In the frame before the derotator: small if everything turned.")
    without_fixed_nm: Number = key(
        math.nan, "The same after the fixed part is taken out: small if the split explains all."
    )
    expected_nm: Number = key(math.nan, "From the errors of the estimates alone.")


def consistency(series: Series, split: Split) -> Consistency:
    """Compare the estimates of all pairs of angles of a `series` with its `split`; NaN with one angle."""
    moving = replace(series, zernike_nm=series.zernike_nm - split.fixed.zernike_nm)
    variance = np.trace(series.covariance_nm2, axis1=1, axis2=2)
    first, second = np.triu_indices(len(variance), 1)
    return Consistency(
        _pairwise_rms(series.zernike_nm),
        _pairwise_rms(series.turned_back(split.sense).zernike_nm),
        _pairwise_rms(moving.turned_back(split.sense).zernike_nm),
        _mean(np.sqrt(variance[first] + variance[second])),
    )


def _pairwise_rms(zernike_nm: np.ndarray) -> float:
    first, second = np.triu_indices(len(zernike_nm), 1)
    return _mean(np.sqrt(np.sum((zernike_nm[first] - zernike_nm[second]) ** 2, axis=1)))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
