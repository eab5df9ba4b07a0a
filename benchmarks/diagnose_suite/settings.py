"""Under which conditions the recordings of the suite are made, and which recipe diagnoses them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

RAMP_FRAMES = 8  # at every offset
EXPOSURE_S = 0.1  # of a frame; on sky ten screens long
# Up and down between each other, so that every direction of travel meets every part of the ramp.
OFFSETS_NM = (-300, -200, -100, 0, 100, 200, 300, 250, 150, 50, -50, -150, -250)
BENCH, SKY = "bench", "sky"
NARROW, BROAD = "narrow_h", "j_h"
DIVERSITY_NM = {6: -170.0}
SEEING_ARCSEC, NCPA_NM, MOTION_MAS = (0.4, 0.8), (80.0, 160.0), (5.0, 9.0)  # drawn between
WAVELENGTHS_PER_BAND = 11
SKY_PUPIL_SAMPLES = 96  # 4.5 times what the window needs at the shortest wavelength


@dataclass(frozen=True)
class Setting:
    """One class of recordings.

    Attributes
    ----------
    where : {"bench", "sky"}
        Without AO residual and image motion, photons set the limit; with them, speckles do.
    bands : {"narrow_h", "j_h"}
    mag_j : float
        1.3 to 1.5 million photo-electrons per frame.
    frames : int
        Of a cube.
    window : int
        Rows and columns [px].
    """

    where: str
    bands: str
    mag_j: float
    frames: int = 120
    window: int = 64

    @property
    def name(self) -> str:
        """For case names: ``bench_narrow``."""
        return f"{self.where}_{'narrow' if self.bands == NARROW else 'broad'}"

    @property
    def on_sky(self) -> bool:
        """Whether there is an AO residual."""
        return self.where == SKY

    @property
    def recipe(self) -> str:
        """That diagnoses a cube of this class."""
        return "diagnose" if self.on_sky else "diagnose_bench"

    @property
    def highest_noll(self) -> int:
        """Mode up to which that recipe's model reaches."""
        return 66 if self.on_sky else 30

    @property
    def hidden_nolls(self) -> range:
        """Modes in which `high_order_ncpa` is drawn: the radial order beyond the model's."""
        return range(67, 79) if self.on_sky else range(31, 37)

    def sections(self, rng: np.random.Generator) -> dict[str, Mapping[str, Any]]:
        """What all recordings of a case share, as a simulation spec has it."""
        ncpa = {"total_nm": float(rng.uniform(*NCPA_NM)), "modes": 50 if self.on_sky else 29}
        common = {
            "ncpa": ncpa,
            "diversity": {"source": "lens", "zernike": DIVERSITY_NM},
            "detector": {"e_per_adu": 2.0, "read_noise_e": 1.0},
        }
        return common | (self._sky(rng) if self.on_sky else self._bench())

    def recording(self) -> dict[str, Any]:
        """Of the spec's recordings: a star and its exposures."""
        return {
            "role": "ncpa_calibration",
            "mag_j": self.mag_j,
            "bands": self.bands,
            "frames": self.frames,
            "exposure_s": EXPOSURE_S,
            "window": [self.window, self.window],
        }

    def _bench(self) -> dict[str, Mapping[str, Any]]:
        return {"sampling": {"points_per_band": WAVELENGTHS_PER_BAND}}

    def _sky(self, rng: np.random.Generator) -> dict[str, Mapping[str, Any]]:
        wind = {"wind_m_s": float(rng.uniform(6, 14)), "wind_angle_deg": float(rng.uniform(0, 360))}
        return {
            "sky": {"seeing_arcsec": float(rng.uniform(*SEEING_ARCSEC)), **wind},
            "motion": {"rms_mas": float(rng.uniform(*MOTION_MAS))},
            "sampling": {"points_per_band": WAVELENGTHS_PER_BAND, "pupil_samples": SKY_PUPIL_SAMPLES},
        }


SETTINGS = {
    one.name: one
    for one in (
        Setting(BENCH, NARROW, 8.0),
        Setting(BENCH, BROAD, 10.0),
        Setting(SKY, NARROW, 8.0),
        Setting(SKY, BROAD, 10.0),
    )
}
