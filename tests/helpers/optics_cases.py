"""Cases that the tests of optics and estimators share: the UT4 pupil, settings, wavefronts, noisy frames."""

import numpy as np
import torch

from irlos_pipe.effects import EffectSet, SeeingHalo, TipTiltJitter
from irlos_pipe.estimate.calibration_options import NcpaPrior
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand

FACILITY = load_instrument("irlos").facility
UT4, RESIDUAL_LAW, NCPA_LAW = FACILITY.pupil, FACILITY.residual_law, FACILITY.ncpa_law
PRIOR = NcpaPrior(NCPA_LAW, 3.0)
SCALE_MAS = 9.7
MAS_RAD = np.deg2rad(1 / 3.6e6)
DIVERSITY = {6: -170.0}
NARROW_H = ((1600.0, 1.0),)
J_AND_H = ((1170.0, 0.2), (1215.0, 0.3), (1260.0, 0.2), (1560.0, 0.3), (1625.0, 0.4), (1690.0, 0.3))
BAND = ResidualBand(1 / 8, 2.5, 25.0)
READ_NOISE = NoiseModel(1.0, 1.0)


def settings(
    window: int | tuple[int, int] = 64, spectrum=NARROW_H, diversity=DIVERSITY, **changes
) -> PsfSettings:
    """Settings of the UT4 pupil, 9.7 mas pixels; a square window unless stated otherwise."""
    shape = (window, window) if isinstance(window, int) else window
    return PsfSettings(
        **{
            "geometry": UT4,
            "window": shape,
            "pixel_scale_mas": SCALE_MAS,
            "spectrum": spectrum,
            "known": KnownWavefront(dict(diversity)),
        }
        | changes
    )


def shift_nm(pixels: float, pixel_scale_mas: float = SCALE_MAS, diameter_m: float = 8.0) -> float:
    """Noll 2 or 3 [nm RMS] that moves the image by `pixels`: an angle θ is an OPD θ x, and Z2 = 4 x / D."""
    return pixels * pixel_scale_mas * MAS_RAD * diameter_m / 4 * 1e9


def ncpa_nm(seed: int, highest_noll: int = 51, total_nm: float = 142.0) -> dict[int, float]:
    """Aberrations drawn from the law of IRLOS, Noll 2 on, tip and tilt equalised, scaled to `total_nm`."""
    order = np.arange(highest_noll - 1)
    order[1] = 0
    drawn = (70 * np.exp(-0.2 * order) + 10) * np.random.default_rng(seed).standard_normal(len(order))
    return dict(enumerate((drawn * total_nm / np.linalg.norm(drawn)).tolist(), start=2))


def vector(zernike_nm: dict[int, float], nolls) -> torch.Tensor:
    """Coefficients in the order of `nolls`, (1, modes) float64 [nm]."""
    return torch.tensor([[zernike_nm.get(noll, 0.0) for noll in nolls]], dtype=torch.float64)


def halo_and_jitter(model: PsfModel, seeing_arcsec: float = 0.5) -> EffectSet:
    """AO residual and image motion, all parameters free."""
    return EffectSet((SeeingHalo(BAND, RESIDUAL_LAW, seeing_arcsec), TipTiltJitter()), model.grids)


def photons(mag_j: float, exposure_s: float = 1.0) -> float:
    """Photons of the UT4 aperture, 150 000 per second at m_J = 15."""
    return 150_000 * 10 ** (0.4 * (15 - mag_j)) * exposure_s


def draw_frames(mean_e: np.ndarray, frames: int, seed: int, noise: NoiseModel = READ_NOISE) -> torch.Tensor:
    """Frames (frames, rows, columns) with the noise of `noise` about `mean_e`, float32 [e-].

    An excess noise factor F is drawn as F times a Poisson variable of mean / F.
    """
    rng = np.random.default_rng(seed)
    gain, shape = noise.excess_noise_factor, (frames, *np.shape(mean_e)[-2:])
    shot = gain * rng.poisson(np.broadcast_to(np.asarray(mean_e) / gain, shape))
    return torch.as_tensor(shot + np.sqrt(noise.floor_e2) * rng.standard_normal(shape), dtype=torch.float32)


def everything(images: torch.Tensor) -> torch.Tensor:
    return torch.ones(images.shape[-2:], dtype=torch.bool)
