"""Detector constants as told and as measured: which are believed.

What a person or a header says stands. A value that is only the profile's gives way to the frames where these
contradict it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.frames.measured_noise import SIGNIFICANT, MeasuredNoise
from irlos_pipe.frames.recording import FRAMES, PROFILE, Detector

GAIN, READ_NOISE, EXCESS = "detector.e_per_adu", "detector.read_noise_e", "detector.excess_noise_factor"
MAX_SLOPE_ERROR = 0.1  # of the slope: a gain that is known worse is no better than the profile's
NOTABLE = 0.1  # a smaller difference, relative, is neither believed nor worth a warning


@dataclass(frozen=True)
class Constant:
    """One constant of the detector, as used and as measured beside it.

    Attributes
    ----------
    name : str
        Side-car key.
    used : float
        What the reduction goes on with.
    source : str
        Where that comes from.
    measured, error : float
        From the frames, with its 1-sigma error; NaN where they do not tell.
    """

    name: str
    used: float
    source: str
    measured: float
    error: float

    @property
    def contradicted(self) -> bool:
        """Whether the frames disagree, significantly and by more than `NOTABLE`."""
        apart = abs(self.measured - self.used)
        return bool(apart > SIGNIFICANT * self.error and apart > NOTABLE * self.used)


def constants(detector: Detector, sources: Mapping[str, str], noise: MeasuredNoise) -> list[Constant]:
    """Return gain, read noise and excess noise of a `detector`, with what the frames say of each.

    Frames tell only the ratio of excess noise and gain: each is measured as if the other were right. The read
    noise includes the photon noise of dark current and sky.

    Parameters
    ----------
    detector : Detector
        With which the frames were converted to electrons.
    sources : mapping of str to str
        Where its values come from, by side-car key.
    noise : MeasuredNoise
        Of those frames.
    """
    slope, slope_error = noise.excess_noise_factor, noise.excess_noise_error
    gain = detector.e_per_adu * detector.excess_noise_factor / slope if slope > 0 else np.nan
    read_noise = float(np.sqrt(noise.floor_e2)) if noise.floor_e2 > 0 else np.nan
    measured = {
        GAIN: (detector.e_per_adu, gain, gain * slope_error / slope if slope > 0 else np.nan),
        READ_NOISE: (detector.read_noise_e, read_noise, noise.floor_error_e2 / (2 * read_noise)),
        EXCESS: (detector.excess_noise_factor, slope, slope_error),
    }
    return [
        Constant(name, used, sources.get(name, PROFILE), float(value), float(error))
        for name, (used, value, error) in measured.items()
    ]


def believed(
    detector: Detector, sources: Mapping[str, str], noise: MeasuredNoise
) -> tuple[Detector, dict[str, str]]:
    """Return the detector with the profile's values replaced where the frames contradict them, and sources.

    Where the gain is not told it gives way, else the excess noise does if that is not told.

    Parameters
    ----------
    detector, sources, noise
        See `constants`.
    """
    found = {one.name: one for one in constants(detector, sources, noise)}
    new, origin = detector, dict(sources)
    slope = found[EXCESS]
    if slope.contradicted and slope.error < MAX_SLOPE_ERROR * slope.measured:
        if found[GAIN].source == PROFILE:
            new, origin = replace(new, e_per_adu=found[GAIN].measured), origin | {GAIN: FRAMES}
        elif slope.source == PROFILE and slope.measured > 1 - NOTABLE:
            measured = max(1.0, slope.measured)  # no detector is quieter than the photons
            new, origin = replace(new, excess_noise_factor=measured), origin | {EXCESS: FRAMES}
    if found[READ_NOISE].source == PROFILE and found[READ_NOISE].contradicted:
        in_electrons = found[READ_NOISE].measured * new.e_per_adu / detector.e_per_adu
        new, origin = replace(new, read_noise_e=in_electrons), origin | {READ_NOISE: FRAMES}
    return new, origin
