"""What the profile says of an observation: exposures of many reads, with dark current and sky; seeing.

The published experiments idealise: one read per exposure, and no sky.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.simulate.scene import Scene

NoiseOf = Literal["reads", "one_read"]
"""Noise of exposures: of all their reads with sky and dark, or of one read without."""
MONITOR = "mass_dimm"  # by which the paper states the seeing on sky


@dataclass(frozen=True)
class Read:
    """One read of the detector: exposure [s], noise [e- RMS], excess noise, dark current [e-/s]."""

    exposure_s: float
    noise_e: float
    excess_noise_factor: float
    dark_e_per_s: float

    @classmethod
    def of(cls, instrument: Instrument, noise: NoiseOf, stage: str) -> Read | None:
        """Return a read of the detector by the profile; None for exposures of one read.

        Parameters
        ----------
        instrument : Instrument
        noise : {"reads", "one_read"}
        stage : str
            Whose setting `noise` is.

        Raises
        ------
        ConfigurationError
            When the profile does not know its reads.
        """
        if noise == "one_read":
            return None
        defaults = instrument.defaults
        needed = ("detector.read_s", "detector.read_noise_e")
        missing = [key for key in needed if key not in defaults]
        if missing:
            raise ConfigurationError(
                f"the profile {instrument.name} gives no {' and '.join(missing)}; set {stage}.noise=one_read"
            )
        factor, dark = (
            defaults.get(f"detector.{key}", 0.0) for key in ("excess_noise_factor", "dark_e_per_s")
        )
        exposure_s, noise_e = (defaults[key] for key in needed)
        return cls(exposure_s, noise_e, max(1.0, factor), dark)

    def reads_in(self, exposure_s: float) -> int:
        """Return how many reads an exposure is."""
        return max(1, round(exposure_s / self.exposure_s))


def as_read(scene: Scene, read: Read | None) -> Scene:
    """Return a `scene` whose exposures have the noise of all their reads, sky and dark; None changes nothing.

    Charges and their multiplication add up, so that N reads have the statistics of a single one of the
    whole exposure, which is √N times noisier; it takes a hundredth of the time to draw.

    Parameters
    ----------
    scene : Scene
    read : Read or None
    """
    if read is None:
        return scene
    detector = replace(
        scene.detector,
        read_noise_e=float(np.sqrt(read.reads_in(scene.exposure_s))) * read.noise_e,
        excess_noise_factor=read.excess_noise_factor,
        dark_e_per_s=read.dark_e_per_s,
    )
    return replace(scene, detector=detector, sky_e_per_s=sky_e_per_s(scene))


def sky_e_per_s(scene: Scene) -> float:
    """Return the light of the sky in a pixel by the profile, for the bands and optics of a `scene`.

    A lenslet has its part of the pupil and of this light.
    """
    photons_per_s_m0 = scene.photons / scene.exposure_s * 10 ** (0.4 * scene.mag_j)
    spectrum = [(band.centre_nm, band.share) for band in scene.bands]
    of_pupil = scene.facility.sky_photons_per_s(spectrum, photons_per_s_m0, scene.pixel_scale_mas)
    return of_pupil / scene.lenslets**2


def on_spartas_scale(instrument: Instrument, seeing_arcsec: float) -> float:
    """Return a seeing by MASS-DIMM on SPARTA's scale, which the AO residual follows [arcsec]."""
    return float(instrument.seeing_scales[MONITOR].to_sparta(seeing_arcsec))
