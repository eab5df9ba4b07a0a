"""Noise of the frames of a fainter star: of all reads of an exposure, with sky and dark current."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from math import nan
from typing import TYPE_CHECKING, Literal

from irlos_pipe.frames.exposure_noise import ExposureNoise
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.product.results import DITTO, Number, ResultsPart, item

if TYPE_CHECKING:
    from irlos_pipe.instrument.instrument import Instrument
    from irlos_pipe.stages.lift.input import Ramp


class NoiseRow(ResultsPart):
    """Noise of the dimmed frames, beside that of exposures of one read without sky."""

    reads: int | None = item(None, "Reads in an exposure.")
    exposure_s: Number = item(nan, "Exposure of a frame.")
    read_noise_e: Number = item(nan, "Read noise of one read.")
    excess_noise_factor: Number = item(nan, "Variance of the photons over that of Poisson.")
    sky_e: Number = item(nan, "Electrons of sky and of dark current in a pixel of an exposure.")
    dark_e: Number = item(nan, DITTO)
    floor_e2: Number = item(nan, "Variance of a pixel without star.")
    one_read_floor_e2: Number = item(nan, DITTO)


@dataclass(frozen=True)
class Noises:
    """Noise of the dimmed frames, that of one read without sky, and what the former consists of."""

    faint: NoiseModel
    one_read: NoiseModel
    told: ExposureNoise | None

    def row(self, exposure_s: float | None) -> NoiseRow:
        """Return the entry of the results for exposures of `exposure_s`."""
        own = {} if self.told is None else asdict(self.told)
        return NoiseRow(
            **own | {"excess_noise_factor": self.faint.excess_noise_factor},
            exposure_s=exposure_s or math.nan,
            floor_e2=self.faint.floor_e2,
            one_read_floor_e2=self.one_read.floor_e2,
        )


def noises_of(
    ramp: Ramp, mag_j: float, instrument: Instrument, which: Literal["reads", "recorded"]
) -> Noises:
    """Return the noise that the dimmed frames of a ramp are given.

    Parameters
    ----------
    ramp : Ramp
    mag_j : float
        Of its star.
    instrument : Instrument
    which : {"reads", "recorded"}
        See the settings of the stage.
    """
    recorded = ramp.data.noise
    told = _exposure_noise(ramp, mag_j, instrument) if which == "reads" else None
    if told is None:
        return Noises(recorded, recorded, None)
    return Noises(told.beyond(recorded), NoiseModel(1.0, told.read_noise_e**2), told)


def _exposure_noise(ramp: Ramp, mag_j: float, instrument: Instrument) -> ExposureNoise | None:
    """Return the noise of an exposure of a ramp as the instrument reads it; None where that is not known.

    Reads and their noise as told of the recording, else by the profile; the sky as told, else by its
    brightness beside the star's.

    Parameters
    ----------
    ramp : Ramp
    mag_j : float
        Of its star.
    instrument : Instrument
    """
    acquisition, defaults = ramp.acquisition, instrument.defaults
    detector, exposure_s = acquisition.detector, acquisition.exposure_s
    read_s = defaults.get("detector.read_s")
    reads = detector.reads
    noise_e: float | None = detector.read_noise_e / reads**0.5
    if reads == 1 and read_s and exposure_s:
        reads, noise_e = max(1, round(exposure_s / read_s)), defaults.get("detector.read_noise_e")
    if exposure_s is None or noise_e is None:
        return None
    dark_e = defaults.get("detector.dark_e_per_s", 0.0) * exposure_s
    sky_e = max(detector.background_e - dark_e, _sky_e_per_s(ramp, mag_j, instrument) * exposure_s)
    factor = max(detector.excess_noise_factor, defaults.get("detector.excess_noise_factor", 1.0))
    return ExposureNoise(reads, noise_e, factor, sky_e, dark_e)


def _sky_e_per_s(ramp: Ramp, mag_j: float, instrument: Instrument) -> float:
    """Light of the sky in a pixel, from that of the star of known magnitude."""
    acquisition = ramp.acquisition
    star_e = max(float(ramp.data.images_e.double().sum((1, 2)).median()), 0.0)
    star_e_per_s_m0 = star_e / (acquisition.exposure_s or math.inf) * 10 ** (0.4 * mag_j)
    return instrument.facility.sky_photons_per_s(
        acquisition.spectrum, star_e_per_s_m0, acquisition.pixel_scale_mas
    )
