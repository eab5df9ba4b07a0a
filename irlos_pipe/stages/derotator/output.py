"""What is reported of a series of derotator angles and of its split: arrays, results, checks, summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.estimate.derotator import Consistency, Part, Senses, Series, Split, consistency
from irlos_pipe.optics.wavefront import clear_disc, opd_maps_nm
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.stages.derotator.results import ConsistencyRow, PartRow

MAP_SAMPLES = 96
SENSES = {1: "anticlockwise", -1: "clockwise"}
PARTS = {
    "rotating": "turns with the derotator, as at angle 0",
    "fixed": "does not turn",
    "unsplit": "sum of both in modes that cannot be split",
}
CERTAIN = 9.0  # Δχ² between the senses, in units of χ²/ν: three sigma


def rms_nm(zernike_nm: np.ndarray) -> float:
    """Return the RMS over the disc [nm]."""
    return float(np.sqrt(np.sum(zernike_nm**2)))


def series_arrays(geometry: PupilGeometry, series: Series) -> dict[str, Quantity]:
    """Return the estimates of a `series` as measured, and their maps over the pupil of `geometry`."""
    return {
        "noll": Quantity(np.array(series.nolls), "", "Noll index"),
        "angle_deg": Quantity(series.angles_deg, "deg", "turn of the wavefront before the derotator"),
        "zernike_nm": Quantity(series.zernike_nm, "nm", "as measured (cube, mode)", series.sigma_nm),
        "maps/measured_nm": map_of(geometry, series.nolls, series.zernike_nm, "as measured (cube, y, x)"),
    }


def map_of(geometry: PupilGeometry, nolls: Sequence[int], zernike_nm: np.ndarray, text: str) -> Quantity:
    """Return maps of coefficients without tip and tilt.

    Parameters
    ----------
    geometry : PupilGeometry
    nolls : sequence of int
    zernike_nm : ndarray, (..., modes)
    text : str
        Begin of the description.
    """
    maps = opd_maps_nm(nolls, zernike_nm, clear_disc(geometry, MAP_SAMPLES))
    return Quantity(maps.astype(np.float32), "nm", f"{text}, without tip and tilt")


@dataclass(frozen=True)
class SplitOutput:
    """A split with what it was made from."""

    series: Series
    split: Split
    senses: Senses

    @property
    def parts(self) -> dict[str, Part]:
        """Return the parts by name."""
        return {name: getattr(self.split, name) for name in PARTS}

    @property
    def delta_chi2(self) -> float:
        """χ² of the other sense minus that of the one adopted; negative against a sense that was set."""
        return self.senses.delta_chi2 * (1 if self.senses.best.sense == self.split.sense else -1)

    @property
    def consistency(self) -> Consistency:
        """Return how well the angles agree."""
        return consistency(self.series, self.split)

    def results(self) -> dict[str, Any]:
        """Return the keys of `SplitRow`."""
        residual_nm = self.series.zernike_nm - self.split.predicted_nm
        return {
            "modes": list(self.split.nolls),
            "reason": None,
            "sense": SENSES[self.split.sense],
            "delta_chi2": self.delta_chi2,
            "chi2_nu": self.split.chi2_nu,
            "freedom": self.split.freedom,
            "parts": {name: self._part(name) for name in PARTS},
            "consistency": ConsistencyRow(**asdict(self.consistency)),
            "measured_nm": [rms_nm(one) for one in self.series.zernike_nm],
            "residual_nm": [rms_nm(one) for one in residual_nm],
        }

    def _part(self, name: str) -> PartRow:
        part, separable = self.parts[name], self.split.separable
        own = np.flatnonzero(~separable if name == "unsplit" else separable)
        nolls = [self.split.nolls[i] for i in own]
        return PartRow(
            rms_nm=part.rms_nm,
            noise_nm=part.noise_nm,
            zernike_nm=dict(zip(nolls, part.zernike_nm[own].tolist(), strict=True)),
            sigma_nm=dict(zip(nolls, part.sigma_nm[own].tolist(), strict=True)),
        )

    def arrays(self, geometry: PupilGeometry) -> dict[str, Quantity]:
        """Return coefficients and maps of the estimates, of the parts, and of what they leave."""
        nolls, back = self.series.nolls, self.series.turned_back(self.split.sense)
        left = self.series.zernike_nm - self.split.predicted_nm
        text = "before the derotator"
        arrays = series_arrays(geometry, self.series) | {
            "turned_back_nm": Quantity(back.zernike_nm, "nm", f"{text} (cube, mode)", back.sigma_nm),
            "maps/turned_back_nm": map_of(geometry, nolls, back.zernike_nm, f"{text} (cube, y, x)"),
            "maps/residual_nm": map_of(geometry, nolls, left, "measured minus the parts (cube, y, x)"),
        }
        for name, part in self.parts.items():
            arrays[f"{name}_nm"] = Quantity(part.zernike_nm, "nm", PARTS[name], part.sigma_nm)
            arrays[f"maps/{name}_nm"] = map_of(geometry, nolls, part.zernike_nm, PARTS[name])
        return arrays

    def check_explained(self, limit: float) -> Check:
        """Check whether two parts explain the estimates."""
        text = f"χ²/ν = {self.split.chi2_nu:.2f} of the two parts against the single estimates"
        return Check("chi2 of the split", self.split.chi2_nu, "", None, limit, text)

    def check_sense(self) -> Check:
        """Check whether the sense of rotation is certain."""
        margin = self.delta_chi2 / max(1.0, self.split.chi2_nu)
        text = f"{SENSES[self.split.sense]} by {np.sqrt(max(margin, 0)):.1f} sigma"
        return Check("sense of rotation", margin, "", CERTAIN, None, text)

    def summary(self) -> list[str]:
        """Return lines for the terminal."""
        found = self.consistency
        rotating, fixed, unsplit = (
            f"{part.rms_nm:.1f} ± {part.noise_nm:.1f} nm" for part in self.parts.values()
        )
        return [
            f"Derotator       {rotating} RMS turn {SENSES[self.split.sense]}, {fixed} do not, "
            f"{unsplit} cannot be split (χ²/ν {self.split.chi2_nu:.2f})",
            f"  two angles differ by {found.measured_nm:.1f} nm, turned back by "
            f"{found.turned_back_nm:.1f} nm, without the fixed part by {found.without_fixed_nm:.1f} nm "
            f"(expected {found.expected_nm:.1f} nm)",
        ]
