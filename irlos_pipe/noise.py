"""The noise of an image: variance per pixel as a function of the signal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from .recording import Recording


@dataclass(frozen=True)
class NoiseModel:
    """``V = F · signal + floor``: photon noise times the excess noise factor, plus a constant.

    What the frames share, above all the noise of the dark image taken from every one of them, does not
    average out with their number.

    Attributes
    ----------
    excess_noise_factor : float
        F, 1 for Poisson noise.
    floor_e2 : float
        Read noise squared plus the photon noise of background and dark [e-²].
    shared_e2 : float
        Variance of what is the same in all frames [e-²].
    """

    excess_noise_factor: float
    floor_e2: float
    shared_e2: float = 0.0

    @classmethod
    def of(cls, recording: Recording) -> NoiseModel:
        """Noise model of one recording, from its detector constants and measured background."""
        detector = recording.acquisition.detector
        floor = detector.read_noise_e**2 + recording.background_variance_e2
        return cls(detector.excess_noise_factor, floor, recording.dark_variance_e2)

    def variance_e2(self, signal_e):
        """Variance [e-²] of pixels with the mean signal `signal_e` [e-]; array or tensor alike."""
        return self.scatter_e2(signal_e) + self.shared_e2

    def mean_variance_e2(self, signal_e, frames: int):
        """Variance of the mean of so many frames [e-²]."""
        return self.scatter_e2(signal_e) / frames + self.shared_e2

    def scatter_e2(self, signal_e):
        """The part of the variance by which frames differ from each other [e-²]."""
        positive = signal_e.clamp_min(0) if isinstance(signal_e, torch.Tensor) else np.maximum(signal_e, 0)
        return self.excess_noise_factor * positive + self.floor_e2
