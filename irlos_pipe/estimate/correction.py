"""What a correction would gain: images with and without measured aberrations, and what each part costs.

In a mirror's own modes the correction is in any table of shapes in place of Zernike polynomials. The
wavefront is estimated in these up to the last one that the window shows, and is the same in any other basis
of them. A mirror makes other shapes (Karhunen–Loève modes, influence functions), which are fitted to the
estimated wavefront over the clear pupil by least squares:

    minimise Σ (W + Σ c_j M_j − p − t x − s y)²,

with a piston p and tilts t, s of its own, which belong to nobody and to the fast loop.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.effects import Effect, fixed_optics
from irlos_pipe.estimate.calibration_options import StrehlPart
from irlos_pipe.optics.image_quality import ring_means
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.wavefront import modes_at


@dataclass(frozen=True)
class Prediction:
    """Unit-flux images without diversity and their quality."""

    before: np.ndarray  # (rows, columns), with all estimated aberrations, AO residual and jitter
    after: np.ndarray  # the same with the corrected modes removed
    perfect: np.ndarray  # with no aberration, AO residual or jitter
    strehl_before: float  # peak over that of `perfect`, at the mean wavelength of the spectrum
    strehl_after: float
    radius_mas: np.ndarray  # (radii,), as the two that follow
    profile_before: np.ndarray
    profile_after: np.ndarray
    resolution_px: float  # λ/D at the mean wavelength
    modes_before_nm: np.ndarray  # (modes,), those of `before`, tip and tilt of the whole wavefront taken out


@dataclass(frozen=True)
class Offsets:
    """Modal offsets to add to the reference; modes that were not estimated are 0 with an infinite error."""

    nolls: np.ndarray  # (modes,), as the two that follow
    value_nm: np.ndarray
    sigma_nm: np.ndarray  # standard errors


def modal_offsets(
    nolls: Sequence[int], zernike_nm: np.ndarray, sigma_nm: np.ndarray, gain: float, highest_noll: int
) -> Offsets:
    """Return the offsets, from Noll 2 to `highest_noll`, that cancel a part `gain` of the whole wavefront.

    Its estimates and their standard errors are (modes,) [nm RMS].
    """
    table = {noll: (-gain * nm, gain * s) for noll, nm, s in zip(nolls, zernike_nm, sigma_nm, strict=True)}
    corrected = np.arange(2, highest_noll + 1)
    values = np.array([table.get(noll, (0.0, np.inf)) for noll in corrected.tolist()])
    return Offsets(corrected, values[:, 0], values[:, 1])


def predict_correction(
    settings: PsfSettings,
    nolls: Sequence[int],
    fitted_modes_nm: np.ndarray,
    zernike_nm: np.ndarray,
    gain: np.ndarray,
    effects: Sequence[Effect],
) -> Prediction:
    """Return images before and after a correction; tip and tilt are left out of both.

    The `fitted_modes_nm` go with the `effects`, AO residual, jitter and others, all held; `zernike_nm` are
    those of the whole wavefront, which is what is corrected, by the part `gain` of each mode, (modes,) all
    three.
    """
    model = light_path(replace(settings, known=KnownWavefront()), nolls)
    motion = np.isin(nolls, TIP_TILT)
    now_nm = np.where(motion, fitted_modes_nm - zernike_nm, fitted_modes_nm)
    left_nm = np.where(motion, now_nm, fitted_modes_nm - gain * zernike_nm)
    wavefronts = torch.as_tensor(np.stack([now_nm, left_nm]))
    images = model.images(wavefronts, fixed_optics(effects, model.grids)).double().numpy()
    perfect = model.images(torch.zeros(1, len(nolls)))[0].double().numpy()
    (rows, columns), peak = settings.window, perfect.max()
    centre_px, reach_px = ((rows - 1) / 2, (columns - 1) / 2), min(rows, columns) // 2
    rings = [ring_means(image, centre_px, reach_px) for image in images]
    return Prediction(
        before=images[0],
        after=images[1],
        perfect=perfect,
        strehl_before=float(images[0].max() / peak),
        strehl_after=float(images[1].max() / peak),
        radius_mas=rings[0][0] * settings.pixel_scale_mas,
        profile_before=rings[0][1],
        profile_after=rings[1][1],
        resolution_px=settings.resolution_px,
        modes_before_nm=now_nm,
    )


ALL = "all together"


def strehl_budget(
    settings: PsfSettings,
    nolls: Sequence[int],
    modes_nm: Mapping[str, np.ndarray],
    effects: Mapping[str, Effect],
) -> list[StrehlPart]:
    """Return the budget, the whole model first.

    The Strehl ratio is the brightest pixel over that of the image without aberrations. Small parts multiply,
    ``S ≈ exp(-(2π σ/λ)²)`` each; larger ones interfere, so that the product is not that of all together.

    Diversity and introduced defocus in the `settings` are left out; `modes_nm` are parts of the wavefront by
    name, (modes,) each, zero in the modes of the others; all parameters of the `effects` are held.
    """
    model = light_path(replace(settings, known=KnownWavefront()), nolls)
    nothing = np.zeros(len(nolls))
    peak = _peak(model, nothing, [])

    def strehl(names: Sequence[str]) -> float:
        wavefront = sum((modes_nm[name] for name in names if name in modes_nm), nothing)
        return _peak(model, wavefront, [effects[name] for name in names if name in effects]) / peak

    every = [*modes_nm, *effects]
    parts = [StrehlPart(ALL, float(np.linalg.norm(sum(modes_nm.values(), nothing))), strehl(every), 1.0)]
    for name in every:
        wfe_nm = float(np.linalg.norm(modes_nm[name])) if name in modes_nm else math.nan
        others = [other for other in every if other != name]
        parts.append(StrehlPart(name, wfe_nm, strehl([name]), strehl(others)))
    return parts


def _peak(model: LightPath, modes_nm: np.ndarray, effects: Sequence[Effect]) -> float:
    """Brightest pixel of a unit-flux image."""
    return float(model.images(torch.as_tensor(modes_nm)[None], fixed_optics(effects, model.grids)).max())


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
