"""Rotation of wavefronts about the optical axis, on Zernike coefficients: exact, no interpolation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.optics.zernike import noll_to_nm


def partner(noll: int) -> int:
    """Return the Noll index of the mode that a rotation mixes `noll` with; itself where it is symmetric.

    Modes of the same n and |m| have neighbouring indices.
    """
    n, m = noll_to_nm(noll)
    return next(other for other in (noll - 1, noll, noll + 1) if other and noll_to_nm(other) == (n, -m))


def rotation_matrix(nolls: Sequence[int], angle_deg: float) -> np.ndarray:
    """Return the matrix that turns a wavefront anticlockwise (from +x towards +y) by `angle_deg`.

    ``W'(ρ, θ) = W(ρ, θ − α)``: the cosine and sine coefficients (c, s) of every (n, |m|) turn as a
    vector by mα, ``c' = c cos mα − s sin mα``, ``s' = c sin mα + s cos mα``.

    Returns
    -------
    ndarray, (modes, modes)
        To be applied to coefficients in the order of `nolls`.

    Raises
    ------
    ValueError
        When one of the two modes of an (n, |m|) is missing.
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
