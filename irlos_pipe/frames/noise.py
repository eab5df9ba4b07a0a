"""The noise of an image: variance per pixel as a function of the signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TypeVar

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.frames.recording import Detector, Recording

Signal = TypeVar("Signal", float, np.ndarray, "torch.Tensor")
MIN_FRAMES_FOR_NOISE = 10  # with fewer, the scatter of a single pixel over time means little


@dataclass(frozen=True)
class NoiseModel:
    """``V = F · signal + floor``: photon noise times the excess noise factor, plus a constant.

    What the frames share, above all the noise of the dark image taken from every one of them, does not
    average out with their number.
    """

    excess_noise_factor: float  # F, 1 for Poisson noise
    floor_e2: float  # read noise squared plus the photon noise of background and dark [e-²]
    shared_e2: float = 0.0  # variance of what is the same in all frames [e-²]

    @classmethod
    def of(cls, recording: Recording) -> NoiseModel:
        """Return the noise of one recording, from its detector constants and measured background."""
        own = cls.of_detector(recording.acquisition.detector)
        floor_e2 = own.floor_e2 + recording.background_variance_e2
        return cls(own.excess_noise_factor, floor_e2, recording.dark_variance_e2)

    @classmethod
    def pooled(cls, recordings: Sequence[Recording]) -> NoiseModel:
        """Return the mean noise of all frames of some `recordings`."""
        frames = [max(1, recording.frames) for recording in recordings]
        return cls(*np.average([astuple(cls.of(one)) for one in recordings], axis=0, weights=frames).tolist())

    @classmethod
    def of_detector(cls, detector: Detector) -> NoiseModel:
        """Return the noise of photons and read-out alone, without that of background and dark."""
        return cls(detector.excess_noise_factor, detector.read_noise_e**2)

    def variance_e2(self, signal_e: Signal) -> Signal:
        """Return the variance [e-²] of pixels with the mean signal `signal_e` [e-]."""
        return self.scatter_e2(signal_e) + self.shared_e2

    def minus_quasi_likelihood(self, images_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
        """``∫ (t - d)/V(t) dt`` from 0 to m, per pixel, for data d and model m [e-]; V is constant below 0.

        Its slope with respect to the model is ``-(d - m)/V(m)``, that of ``(d - m)²/2V`` with the variance of
        the model as it is. Beyond its value at m = d it stands for that half χ²; for pure photon noise the
        difference is half the deviance of Poisson's law. Reference: Wedderburn 1974, Biometrika 61, 439.
        """
        factor, floor = self.excess_noise_factor, self.floor_e2 + self.shared_e2
        above = model_e.clamp_min(0)
        growth = torch.log1p(above * (factor / floor)) * (images_e + floor / factor)
        bright = (above - growth) / factor
        if not (model_e < 0).any():
            return bright
        below = model_e.clamp_max(0)
        return bright + (0.5 * below - images_e) * below / floor

    def mean_variance_e2(self, signal_e: Signal, frames: int) -> Signal:
        """Return the variance of the mean of so many `frames` of the mean signal `signal_e` [e-²]."""
        return self.scatter_e2(signal_e) / frames + self.shared_e2

    def scatter_e2(self, signal_e: Signal) -> Signal:
        """Return the part of the variance by which frames differ from each other [e-²]."""
        positive = (
            np.maximum(signal_e, 0)
            if isinstance(signal_e, float | int | np.generic | np.ndarray)
            else signal_e.clamp_min(0)
        )
        return self.excess_noise_factor * positive + self.floor_e2


@dataclass(frozen=True)
class ExposureNoise:
    """What makes the noise of one exposure."""

    reads: int  # that are added up
    read_noise_e: float  # of one read, rounding to whole ADU included [e- RMS]
    excess_noise_factor: float
    sky_e: float = 0.0  # mean charge by the sky in a pixel of the exposure [e-]
    dark_e: float = 0.0  # the same by dark current

    @property
    def floor_e2(self) -> float:
        """Variance of a pixel without star, ``N σ² + F (sky + dark)`` [e-²]."""
        photons_e2 = self.excess_noise_factor * (self.sky_e + self.dark_e)
        return self.reads * self.read_noise_e**2 + photons_e2

    def beyond(self, recorded: NoiseModel) -> NoiseModel:
        """Return this noise, or what was `recorded` where that is more."""
        return NoiseModel(
            max(self.excess_noise_factor, recorded.excess_noise_factor),
            max(self.floor_e2, recorded.floor_e2),
            recorded.shared_e2,
        )
