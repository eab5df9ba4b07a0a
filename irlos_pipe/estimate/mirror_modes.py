"""The correction in a mirror's own modes: any table of shapes in place of Zernike polynomials.

The wavefront is estimated in Zernike polynomials up to the last one that the window shows, and is the same in
any other basis of these. A mirror makes other shapes (Karhunen–Loève modes, influence functions), which are
fitted to the estimated wavefront over the clear pupil by least squares:

    minimise Σ (W + Σ c_j M_j − p − t x − s y)²,

with a piston p and tilts t, s of its own, which belong to nobody and to the fast loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.optics.wavefront import modes_at

RANK = 1e-6  # part of the largest singular value below which one counts as zero
LEFT_OUT = (1, *TIP_TILT)


@dataclass(frozen=True)
class MirrorOffsets:
    """Offsets of a mirror's modes, to be added to its reference."""

    value: np.ndarray  # (modes,), in the unit of the table's modes
    sigma: np.ndarray  # (modes,), standard errors by the errors of the wavefront
    # RMS over the clear pupil of the estimated wavefront, and of what a gain of 1 leaves of it; without
    # piston, tip and tilt
    before_nm: float
    after_nm: float


def mirror_offsets(
    maps_nm: np.ndarray,
    nolls: Sequence[int],
    zernike_nm: np.ndarray,
    covariance_nm2: np.ndarray,
    lit: np.ndarray,
    gain: float = 1.0,
) -> MirrorOffsets:
    """Return the offsets of a mirror's modes that cancel a part `gain` of a wavefront.

    The OPD of a unit of each mode is `maps_nm` (modes, n, n), n samples across the diameter, row index is y;
    the clear pupil is `lit` (n, n). The estimated wavefront is `zernike_nm` (Zernike modes,), its covariance
    (Zernike modes, Zernike modes). Raises ValueError if modes of the table depend on one another over the
    clear pupil, or are no numbers there.
    """
    shapes = maps_nm[:, lit].astype(float)
    if not np.isfinite(shapes).all():
        raise ValueError("not a number within the clear pupil")
    both = np.vstack([shapes, modes_at(LEFT_OUT, lit)])
    size = np.sqrt((both**2).mean(axis=1))
    rank = int(np.linalg.matrix_rank(both / np.where(size > 0, size, 1.0)[:, None], rtol=RANK))
    if rank < len(both):
        raise ValueError(
            f"over the clear pupil, and beside piston, tip and tilt, its {len(shapes)} modes are only "
            f"{rank - len(LEFT_OUT)} different shapes"
        )
    to_modes = -gain * np.linalg.pinv(both.T / size) / size[:, None]
    zernikes = modes_at(nolls, lit).T
    by_zernike = (to_modes @ zernikes)[: len(shapes)]
    value = by_zernike @ zernike_nm
    wavefront_nm = zernikes @ zernike_nm
    before_nm = _left_nm(wavefront_nm, modes_at(LEFT_OUT, lit))
    return MirrorOffsets(
        value,
        np.sqrt(np.einsum("ij,jk,ik->i", by_zernike, covariance_nm2, by_zernike)),
        before_nm,
        _left_nm(wavefront_nm, both),
    )


def _left_nm(wavefront_nm: np.ndarray, shapes: np.ndarray) -> float:
    """RMS of what a fit of some shapes leaves of a wavefront."""
    scaled = shapes / np.sqrt((shapes**2).mean(axis=1))[:, None]
    fitted = np.linalg.lstsq(scaled.T, wavefront_nm, rcond=None)[0]
    return float(np.sqrt(np.mean((wavefront_nm - scaled.T @ fitted) ** 2)))
