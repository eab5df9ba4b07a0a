"""LIFT as the truth sensor of a closed loop: a measurement per image, or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cramer_rao import cramer_rao_nm
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import ramp_effects
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.broad_band import frame_settings
from irlos_pipe.paper.common.observation import model_effects_of
from irlos_pipe.paper.common.ramps import TTF, Knowledge
from irlos_pipe.simulate.scene import Scene

FOCUS = TTF.index(DEFOCUS)
# A loop discards a measurement so uncertain, or so far from where a closed loop can be. Near
# the faint limit LIFT ends now and then in a noise peak, far away and with a small formal error.
LARGEST_SIGMA_NM, FARTHEST_NM = 100.0, 200.0


@dataclass(frozen=True)
class FocusSensor:
    """LIFT with tip, tilt and defocus free, started from zero: the loops hold the image there.

    Attributes
    ----------
    model : ImageModel
        With AO residual and jitter.
    zero_nm : float
        What it measures where there is no defocus, if that is known [nm RMS].
    """

    model: ImageModel
    zero_nm: float = 0.0

    def measure(self, images_e: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return the defocus of every image, (images,) [nm RMS]; NaN where none is to be used.

        Parameters
        ----------
        images_e : ndarray, (images, rows, columns)
        noise : NoiseModel
            Of an image.
        """
        images = torch.as_tensor(images_e)
        good = torch.ones(images.shape[1:], dtype=torch.bool)
        start = torch.zeros(len(images), len(TTF), dtype=torch.float64)
        result = lift(self.model, images, good, noise, start, LiftOptions("model"))
        defocus, sigma = result.mode(DEFOCUS)
        credible = (sigma < LARGEST_SIGMA_NM) & (defocus.abs() < FARTHEST_NM)
        measured = torch.where(result.solution.converged & credible, defocus, torch.nan)
        return measured.numpy() - self.zero_nm

    def bound_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """Return the Cramér–Rao bound at zero defocus [nm RMS].

        Parameters
        ----------
        seen_e : float
            Electrons in the window.
        noise : NoiseModel
        """
        zero = torch.zeros(1, len(TTF), dtype=torch.float64)
        in_window = self.model.psf.images(zero, self.model.optics).double().sum().cpu()
        flux = seen_e / in_window[None]
        return float(cramer_rao_nm(self.model, zero, flux, noise)[0, FOCUS])

    def photon_noise_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """Return the noise of a measurement without an AO residual [nm RMS]: the bound, which LIFT reaches.

        `seen_e` and `noise` are as of `bound_nm`.
        """
        return self.bound_nm(seen_e, noise)


def focus_sensor(scene: Scene, knowledge: Knowledge) -> FocusSensor:
    """Return the sensor for a `scene`, with the `knowledge` from a calibration."""
    psf = PsfModel(frame_settings(scene, knowledge.ncpa_nm), TTF)
    effects = ramp_effects(model_effects_of(scene), knowledge.effects)
    model = tabulated(ImageModel(psf, effects), torch.zeros(1, len(TTF), dtype=torch.float64))
    return FocusSensor(model)
