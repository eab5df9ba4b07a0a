"""Zernike coefficients of other programs as Noll's in nm RMS: index, size, unit and annulus.

The polynomials of all conventions are the same but for order and factor, with θ from +x towards +y; those of
the annulus are made of them (V. N. Mahajan, "Zernike annular polynomials", JOSA 71, 75, 1981).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.polynomial import Legendre

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.optics.zernike import noll_to_nm, zernike_basis

FIRST = {"noll": 1, "osa": 0, "ansi": 0, "fringe": 1}  # index of piston
SIZES = ("rms", "peak", "pv")
IN_NM = {
    "nm": 1.0,
    "um": 1e3,
    "m": 1e9,
    "waves": 1.0,
    "rad": 1 / (2 * math.pi),
}  # waves and radians: in wavelengths
HIGHEST = 1000  # Noll index


def noll_nm(
    coefficients: Mapping[int, float] | Sequence[float] | np.ndarray,
    order: str = "noll",
    *,
    unit: str = "nm",
    size: str | None = None,
    wavelength_nm: float | None = None,
    obscuration: float = 0.0,
) -> dict[int, float]:
    """Return Zernike coefficients of any convention as ``{Noll: nm RMS}``, without piston.

    Parameters
    ----------
    coefficients : mapping or sequence
        By index, or in the order of the convention, beginning with piston.
    order : {"noll", "osa", "ansi", "fringe"}
        Index: Noll's, OSA's (ANSI's is the same) or Fringe (University of Arizona).
    unit : {"nm", "um", "m", "waves", "rad"}
        Of the optical path difference; that of a mirror is twice its surface.
    size : {"rms", "peak", "pv"}, optional
        What a coefficient is: RMS of the mode over the disc; its value at the rim, as of polynomials without
        a factor; or peak to valley over the disc. By default ``peak`` for Fringe, ``rms`` for others.
    wavelength_nm : float, optional
        For waves and radians [nm].
    obscuration : float
        Hole of annular polynomials, of unit RMS over the annulus, in parts of the diameter. Leave it out for
        coefficients of disc polynomials, whatever the pupil.

    Raises
    ------
    ConfigurationError
        For an unknown convention, an index that it does not have, and values that are not numbers.
    """
    size = size or ("peak" if order == "fringe" else "rms")
    for name, word, words in (("order", order, FIRST), ("size", size, SIZES), ("unit", unit, IN_NM)):
        if word not in words:
            raise ConfigurationError(f"noll_nm(): {name} = {word!r}{suggestion(word, words)}")
    if unit in ("waves", "rad") and not (wavelength_nm or 0) > 0:
        raise ConfigurationError(f"noll_nm(): coefficients in {unit} need wavelength_nm")
    if not 0 <= obscuration < 1 or (obscuration and size != "rms"):
        raise ConfigurationError("noll_nm(): obscuration is a part of the diameter below 1, with size 'rms'")
    in_nm = IN_NM[unit] * (wavelength_nm or 0.0) if unit in ("waves", "rad") else IN_NM[unit]
    given = coefficients if isinstance(coefficients, Mapping) else dict(enumerate(coefficients, FIRST[order]))
    found: dict[int, float] = {}
    for index, value in given.items():
        noll = _noll(index, order)
        if not isinstance(value, (int, float, np.number)) or not np.isfinite(value):
            raise ConfigurationError(f"noll_nm(): {order} {index}: {value!r} is no number")
        found[noll] = float(value) * in_nm / _rms_unit(noll, size)
    found = _on_disc(found, obscuration) if obscuration else found
    return {noll: found[noll] for noll in sorted(found) if noll > 1}


def _noll(index: int, order: str) -> int:
    """Noll's index of the mode that has an `index` in another `order`."""
    if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or index < FIRST[order]:
        raise ConfigurationError(
            f"noll_nm(): {index!r} is no index of order '{order}', from {FIRST[order]} on"
        )
    for noll in range(1, HIGHEST + 1):
        n, m = noll_to_nm(noll)
        if index == (
            noll if order == "noll" else _fringe(n, m) if order == "fringe" else (n * (n + 2) + m) // 2
        ):
            return noll
    raise ConfigurationError(f"noll_nm(): {order} {index} is beyond Noll {HIGHEST}")


def _fringe(n: int, m: int) -> int:
    return (1 + (n + abs(m)) // 2) ** 2 - 2 * abs(m) + (m < 0)


def _rms_unit(noll: int, size: str) -> float:
    """How large a mode of unit RMS is: its RMS, its value at the rim, or peak to valley."""
    n, m = noll_to_nm(noll)
    rim = math.sqrt((n + 1) * (1 if m == 0 else 2))
    if size != "pv" or noll == 1:
        return rim if size == "peak" else 1.0
    if m:
        return 2 * rim  # a radial polynomial is largest at the rim
    radial = Legendre.basis(n // 2)  # of 2ρ² - 1
    return rim * (1 - float(radial(np.real(radial.deriv().roots())).min(initial=radial(-1))))


def _on_disc(annular: Mapping[int, float], hole: float) -> dict[int, float]:
    """Coefficients on the disc of polynomials that are orthonormal on the annulus.

    These are those of the disc, orthonormalised with rising order; modes of one azimuthal order at a time.
    """
    found: dict[int, float] = {}
    for m in {noll_to_nm(noll)[1] for noll in annular}:
        highest = max(n for n, own in map(noll_to_nm, annular) if own == m)
        nolls = [
            noll for noll in range(1, (highest + 1) * (highest + 2) // 2 + 1) if noll_to_nm(noll)[1] == m
        ]
        at, weight = np.polynomial.legendre.leggauss(highest + 1)
        radius = np.sqrt((1 + hole**2 + (1 - hole**2) * at) / 2)
        angle = math.pi / 2 / abs(m) if m < 0 else 0.0  # where the mode is largest
        values = zernike_basis(nolls, radius * math.cos(angle), radius * math.sin(angle))
        gram = (values * weight) @ values.T / (2 if m == 0 else 4)
        own = np.array([annular.get(noll, 0.0) for noll in nolls])
        found |= dict(zip(nolls, np.linalg.solve(np.linalg.cholesky(gram).T, own).tolist(), strict=True))
    return found
