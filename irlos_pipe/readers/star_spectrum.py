"""The spectrum of a recording from the curve of its filter and the colour of its star.

Photons per wavelength are those of a black body: real stars differ from it by a few per cent over J and H,
which the free slope of the effect `spectrum` takes up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from irlos_pipe.conventions.errors import InputDataError

C2_NM_K = 1.438776877e7  # second radiation constant
J_NM, H_NM, VEGA_K = 1235.0, 1662.0, 9600.0  # 2MASS bands, and the black body that has no colour between them
OPEN_END = 0.05  # a filter curve that ends above this part of its largest transmission is cut off
DARK = 0.01  # part of the largest transmission below which a filter counts as opaque
POINTS_PER_BAND = 3
COOLEST_K, HOTTEST_K = 1000.0, 50_000.0
Point = tuple[float, float]


def photons(wavelengths_nm: np.ndarray, temperature_k: float) -> np.ndarray:
    """Return photons per wavelength of a black body of `temperature_k` at `wavelengths_nm`, on any scale."""
    return wavelengths_nm**-4.0 / np.expm1(C2_NM_K / (wavelengths_nm * temperature_k))


def colour_of(temperature_k: float) -> float:
    """Return J − H [mag] of a black body of `temperature_k` against Vega's."""
    star, vega = (photons(np.array([J_NM, H_NM]), t) for t in (temperature_k, VEGA_K))
    return float(-2.5 * np.log10(star[0] / star[1] * vega[1] / vega[0]))


def temperature_of(j_minus_h: float, where: str) -> float:
    """Return the temperature of the black body that has a colour `j_minus_h` [K]; `where` begins an error.

    Raises `InputDataError` for a colour that no star from 1000 to 50000 K has.
    """
    bluest, reddest = colour_of(HOTTEST_K), colour_of(COOLEST_K)
    if not bluest < j_minus_h < reddest:
        raise InputDataError(
            f"{where} j_minus_h = {j_minus_h:g} is the colour of no star; it should lie between {bluest:.2f} "
            f"and {reddest:.2f}"
        )
    return float(scipy.optimize.brentq(lambda t: colour_of(t) - j_minus_h, COOLEST_K, HOTTEST_K))


def spectrum_of(curve: Sequence[Point], temperature_k: float, where: str) -> list[Point]:
    """Return wavelengths and photon weights, three in every band of the filter.

    Each third of a band's photons stands at its own mean wavelength. The `curve` has wavelengths [nm] and
    transmissions, `temperature_k` is that of the star, `where` begins the message of an error.

    Raises `InputDataError` for a curve that is no function of wavelength, or ends where the filter still
    transmits.
    """
    wavelengths_nm, transmission = _checked(curve, where)
    fine = np.linspace(wavelengths_nm[0], wavelengths_nm[-1], 4000)
    passed = np.interp(fine, wavelengths_nm, transmission)
    weight = np.where(passed > DARK * transmission.max(), passed * photons(fine, temperature_k), 0.0)
    lit = np.flatnonzero(weight)
    bands = np.split(lit, np.flatnonzero(np.diff(lit) > 1) + 1)
    points = [point for band in bands for point in _thirds(fine[band], weight[band])]
    total = sum(share for _, share in points)
    return [(nm, share / total) for nm, share in points]


def _checked(curve: Sequence[Point], where: str) -> tuple[np.ndarray, np.ndarray]:
    wavelengths_nm, transmission = np.array(curve, float).T
    if np.any(np.diff(wavelengths_nm) <= 0) or np.any(transmission < 0) or not transmission.any():
        raise InputDataError(
            f"{where} filter_curve: wavelengths should rise, and transmissions not be negative or all zero"
        )
    for end, which in ((0, "shortest"), (-1, "longest")):
        if transmission[end] > OPEN_END * transmission.max():
            raise InputDataError(
                f"{where} filter_curve does not cover the band: at its {which} wavelength, "
                f"{wavelengths_nm[end]:g} nm, the filter still transmits {transmission[end]:g}; "
                "continue it to zero"
            )
    return wavelengths_nm, transmission


def _thirds(wavelengths_nm: np.ndarray, weight: np.ndarray) -> list[Point]:
    """Mean wavelength and photons of each part of a band that holds the same number of them."""
    middle = (np.cumsum(weight) - weight / 2) / weight.sum()
    parts = np.minimum((middle * POINTS_PER_BAND).astype(int), POINTS_PER_BAND - 1)
    return [
        (
            float(np.average(wavelengths_nm[parts == k], weights=weight[parts == k])),
            float(weight[parts == k].sum()),
        )
        for k in np.unique(parts)
    ]
