"""Zernike polynomials, Noll index and Noll normalisation (CONTRACT of signs: theta from +x towards +y).

Reference: R. J. Noll, "Zernike polynomials and atmospheric turbulence", JOSA 66, 207 (1976).
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import count, islice
from math import isqrt, pi, sqrt

import numpy as np
from numpy.polynomial import Legendre, chebyshev, legendre

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion

FIRST = {"noll": 1, "osa": 0, "ansi": 0, "fringe": 1}  # index of piston
IN_NM = {"nm": 1.0, "um": 1e3, "m": 1e9}
IN_WAVES = {"waves": 1.0, "rad": 1 / (2 * pi)}
HIGHEST = 1000  # Noll index


def noll_to_nm(noll: int) -> tuple[int, int]:
    """Return the radial order n and signed azimuthal order m of a Noll index.

    Positive m stands for cos(m theta), negative m for sin(|m| theta); even Noll
    indices are cosines.

    Raises `ValueError` if `noll` is below 1.
    """
    if noll < 1:
        raise ValueError(f"Noll indices start at 1, got {noll}")
    n = (isqrt(8 * noll - 7) - 1) // 2
    position = noll - n * (n + 1) // 2 - 1
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m if noll % 2 == 0 else -m


def zernike(noll: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return one Zernike polynomial, of unit RMS over the disc, at points `x`, `y` in units of its radius.

    Noll 1 is piston. Points outside the disc get the continuation of the polynomial: the amplitude of the
    pupil cuts it off.
    """
    return zernike_basis([noll], x, y)[0]


def zernike_basis(nolls, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return Zernike polynomials `nolls` at (`x`, `y`) in units of the radius, ``(len(nolls), *x.shape)``.

    Modes of one azimuthal order share a recurrence over the degree, which stays exact where sums of powers
    of the radius cancel: those err by 4e-5 at Noll 500 and by 0.6 at Noll 1000.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    basis = np.empty((len(nolls), *x.shape))
    orders = np.array([noll_to_nm(noll) for noll in nolls]).reshape(-1, 2)
    for azimuthal in np.unique(np.abs(orders[:, 1])):
        turned = (x + 1j * y) ** int(azimuthal)  # ρ^|m| exp(i|m|θ)
        own = np.flatnonzero(np.abs(orders[:, 1]) == azimuthal)
        highest = (orders[own, 0].max() - azimuthal) // 2
        factors = islice(_radial_factors(int(azimuthal), x**2 + y**2), int(highest) + 1)
        for degree, factor in enumerate(factors):
            for index in own[orders[own, 0] == azimuthal + 2 * degree]:
                n, m = orders[index]
                norm = sqrt(n + 1) if m == 0 else sqrt(2 * (n + 1))
                np.multiply(turned.real if m >= 0 else turned.imag, norm * factor, out=basis[index])
    return basis


def _radial_factors(m: int, squared: np.ndarray) -> Iterator[np.ndarray]:
    """Yield ``R_n^m / ρ^m`` for n = m, m + 2, ... at `squared` radii: Jacobi's ``P_k^(0, m)(2ρ² - 1)``.

    Recurrence: Abramowitz & Stegun 1972, Handbook of Mathematical Functions, 22.7.1.
    """
    t = 2 * squared - 1
    before, now = np.ones_like(t), ((m + 2) * t - m) / 2
    yield before
    for k in count(2):
        yield now
        twice = 2 * k + m
        slope = (twice - 1) * (twice * (twice - 2) * t - m**2)
        after = slope * now - 2 * (k - 1) * (k + m - 1) * twice * before
        before, now = now, after / (2 * k * (k + m) * (twice - 2))


def in_products(nolls: Sequence[int], degree: int, reach: float, middle: Sequence[float]) -> np.ndarray:
    """Return Zernike modes in products ``T_b(y/reach) T_a(x/reach)``, (modes, b, a): interpolated, so exact.

    Their values at the corners of the square rule how exact: rounding of float64 errs by 4e-8 at degree 20.

    The `degree` of the products is at least that of the modes. Their x and y count from the `middle` of the
    square, x and y [radii], whose sides are at the distance `reach` [radii].
    """
    nodes = chebyshev.chebpts1(degree + 1)
    invert = np.linalg.inv(chebyshev.chebvander(nodes, degree))
    values = zernike_basis(nolls, *np.meshgrid(middle[0] + reach * nodes, middle[1] + reach * nodes))
    return invert @ values @ invert.T


def partner(noll: int) -> int:
    """Return the Noll index of the mode that a rotation mixes `noll` with; itself where it is symmetric.

    Modes of the same n and |m| have neighbouring indices.
    """
    n, m = noll_to_nm(noll)
    return next(other for other in (noll - 1, noll, noll + 1) if other and noll_to_nm(other) == (n, -m))


def rotation_matrix(nolls: Sequence[int], angle_deg: float) -> np.ndarray:
    """Return the matrix that turns a wavefront anticlockwise (from +x towards +y) by `angle_deg`.

    ``W'(ρ, θ) = W(ρ, θ − α)``: the cosine and sine coefficients (c, s) of every (n, |m|) turn as a
    vector by mα, ``c' = c cos mα − s sin mα``, ``s' = c sin mα + s cos mα``. The matrix (modes, modes) is to
    be applied to coefficients in the order of `nolls`.

    Raises `ValueError` when one of the two modes of an (n, |m|) is missing.
    """
    place = {noll: row for row, noll in enumerate(nolls)}
    lonely = [noll for noll in nolls if partner(noll) not in place]
    if lonely:
        raise ValueError(f"Noll {lonely[0]} turns into {partner(lonely[0])}, which is not among the modes")
    matrix = np.zeros((len(nolls), len(nolls)))
    for noll, row in place.items():
        m = noll_to_nm(noll)[1]
        # Seen from either of the two, the other enters with the sine of its own signed mα.
        matrix[row, row] = np.cos(m * np.radians(angle_deg))
        matrix[row, place[partner(noll)]] += -np.sin(m * np.radians(angle_deg))
    return matrix


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

    The polynomials of all conventions are the same but for order and factor, with θ from +x towards +y.

    Parameters
    ----------
    coefficients : mapping or sequence
        By index, or in the order of the convention, beginning with piston.
    order : {"noll", "osa", "ansi", "fringe"}
        Index: Noll's, OSA's (ANSI's is the same) or Fringe (University of Arizona).
    unit : {"nm", "um", "m", "waves", "rad"}
        Of the optical path difference, which is twice the surface of a mirror; waves and radians are those of
        `wavelength_nm`.
    size : {"rms", "peak", "pv"}, optional
        What a coefficient is: RMS of the mode over the disc; its value at the rim, as of polynomials without
        a factor; or peak to valley over the disc. By default ``peak`` for Fringe, ``rms`` for others.
    obscuration : float
        Hole of annular polynomials, of unit RMS over the annulus, in parts of the diameter. Leave it out for
        coefficients of disc polynomials, whatever the pupil.

    Raises `ConfigurationError` for unknown conventions and indices, and values that are not numbers.
    """
    size = size or ("peak" if order == "fringe" else "rms")
    for word, words in ((order, FIRST), (size, ("rms", "peak", "pv")), (unit, [*IN_NM, *IN_WAVES])):
        if word not in words:
            raise ConfigurationError(f"noll_nm(): unknown {word!r}{suggestion(word, words)}")
    if unit in IN_WAVES and not (wavelength_nm or 0) > 0:
        raise ConfigurationError(f"noll_nm(): coefficients in {unit} need wavelength_nm")
    if not 0 <= obscuration < 1 or (obscuration and size != "rms"):
        raise ConfigurationError("noll_nm(): obscuration is a part of the diameter below 1, with size 'rms'")
    in_nm = IN_NM[unit] if unit in IN_NM else IN_WAVES[unit] * float(wavelength_nm or 0)
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
    for noll in range(1, HIGHEST + 1):
        n, m = noll_to_nm(noll)
        fringe = (1 + (n + abs(m)) // 2) ** 2 - 2 * abs(m) + (m < 0)
        if index == {"noll": noll, "fringe": fringe}.get(order, (n * (n + 2) + m) // 2):
            return noll
    raise ConfigurationError(
        f"noll_nm(): {index!r} is no index of order '{order}': {FIRST[order]}, … up to that of Noll {HIGHEST}"
    )


def _rms_unit(noll: int, size: str) -> float:
    """How large a mode of unit RMS is: its RMS, its value at the rim, or peak to valley."""
    n, m = noll_to_nm(noll)
    rim = sqrt((n + 1) * (1 if m == 0 else 2))
    if size != "pv" or noll == 1:
        return rim if size == "peak" else 1.0
    if m:
        return 2 * rim  # a radial polynomial is largest at the rim
    radial = Legendre.basis(n // 2)  # of 2ρ² - 1
    return rim * (1 - float(radial(np.real(radial.deriv().roots())).min(initial=radial(-1))))


def _on_disc(annular: Mapping[int, float], hole: float) -> dict[int, float]:
    """Coefficients on the disc of annular polynomials, those of the disc orthonormalised with rising order.

    Reference: V. N. Mahajan, "Zernike annular polynomials for imaging systems", JOSA 71, 75 (1981).
    """
    found: dict[int, float] = {}
    for m in {noll_to_nm(noll)[1] for noll in annular}:
        nolls = [noll for noll in range(1, HIGHEST + 1) if noll_to_nm(noll)[1] == m]
        nolls = nolls[: max(nolls.index(noll) for noll in annular if noll_to_nm(noll)[1] == m) + 1]
        at, weight = legendre.leggauss(2 * len(nolls) + abs(m))
        radius = np.sqrt((1 + hole**2 + (1 - hole**2) * at) / 2)
        angle = pi / 2 / abs(m) if m < 0 else 0.0  # where the mode is largest
        values = zernike_basis(nolls, radius * np.cos(angle), radius * np.sin(angle))
        gram = (values * weight) @ values.T / (2 if m == 0 else 4)
        own = np.array([annular.get(noll, 0.0) for noll in nolls])
        found |= dict(zip(nolls, np.linalg.solve(np.linalg.cholesky(gram).T, own).tolist(), strict=True))
    return found
