"""Stage `derotator`: the part of the NCPAs that turns with the derotator, and the part that does not."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import Any, ClassVar, Literal

import numpy as np

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.estimate.derotator import (
    Consistency,
    Part,
    Series,
    Split,
    consistency,
    try_both_senses,
    usable_modes,
)
from irlos_pipe.optics.wavefront import clear_disc, opd_maps_nm
from irlos_pipe.product.product import Check, Quantity, declared
from irlos_pipe.product.results import DITTO, ByNoll, Number, ResultsPart, StageResults, item
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.calibrate.stage import AngleRow, cube_estimates

VERSION = 1
NEEDS = ("calibrate",)
DEPENDS_ON = frozenset({"instrument"})
ARRAYS = {
    "noll": ("", "mode", "Noll index"),
    "angle_deg": ("deg", "cube", "turn of the wavefront before the derotator"),
    "zernike_nm": ("nm ±", "cube, mode", "as measured"),
    "turned_back_nm": ("nm ±", "cube, mode", "before the derotator"),
    "rotating_nm": ("nm ±", "mode", "turns with the derotator, as at angle 0"),
    "fixed_nm": ("nm ±", "mode", "does not turn"),
    "unsplit_nm": ("nm ±", "mode", "sum of both in modes that cannot be split"),
    "maps/measured_nm": ("nm", "cube, y, x", "as measured, without tip and tilt"),
    "maps/turned_back_nm": ("nm", "cube, y, x", "before the derotator, without tip and tilt"),
    "maps/residual_nm": ("nm", "cube, y, x", "measured minus the parts, without tip and tilt"),
    "maps/<part>_nm": ("nm", "y, x", "the part, without tip and tilt"),
}
CHECKS = {
    "chi2 of the split": (
        "how well a part before and a part behind the derotator explain the estimates",
        "max_chi2_nu",
    ),
    "sense of rotation": ("how much worse the other sense of rotation fits", ""),
}
MAP_SAMPLES = 96  # across the pupil in maps
SENSES = {1: "anticlockwise", -1: "clockwise"}
PARTS = ("rotating", "fixed", "unsplit")
CERTAIN = 9.0  # Δχ² between the senses, in units of χ²/ν: three sigma


class Config(StageConfig):
    """Settings of the derotator test."""

    sense: Literal["estimate", "anticlockwise", "clockwise"] = item(
        "estimate", "sense in which the wavefront before the derotator turns with growing angle"
    )
    turn_per_degree: float = item(
        1.0, "rotation of the image per degree of the angle; 2 for the angle of a K-mirror", gt=0, le=2
    )
    highest_noll: int | None = item(
        None, "highest Noll mode used; null: all estimated modes", ge=4, le=HIGHEST_NOLL
    )
    max_chi2_nu: float = item(10.0, "QC limit on how well the two parts explain the single estimates", gt=0)


class PartRow(ResultsPart):
    """One part of the wavefront."""

    rms_nm: Number = item(nan, "RMS over the disc, and what of it the errors of the estimates explain.")
    noise_nm: Number = item(nan, DITTO)
    zernike_nm: ByNoll = item({}, "Modes of the part, and their standard errors [nm RMS].")
    sigma_nm: ByNoll = item({}, DITTO)


class DerotatorResults(StageResults):
    """The split of the estimates of all `cubes` into parts."""

    stage: ClassVar[str] = "derotator"
    modes: list[int] = item([], "Noll indices of the modes that were split.")
    reason: str | None = item(None, "Why nothing could be split.")
    sense: str = item("", "``clockwise`` or ``anticlockwise``: how the rotating part turns with the angle.")
    delta_chi2: Number = item(nan, "χ² of the other sense minus that of this one.")
    chi2_nu: Number = item(
        nan, "Reduced χ² of the parts against the single estimates, and its degrees of freedom."
    )
    freedom: int = item(0, DITTO)
    parts: dict[str, PartRow] | None = item(
        None, "``rotating`` (as at angle 0), ``fixed`` and ``unsplit``; None where nothing could be split."
    )
    consistency: Consistency = Consistency()
    measured_nm: list[Number] = item([], "RMS of every estimate, and of what the parts leave of it.")
    residual_nm: list[Number] = item([], DITTO)
    cubes: list[AngleRow] = []


Results = DerotatorResults


def run(ctx: StageContext[Config]) -> StageOutput:
    """Split the estimates of all cubes; report that this cannot be done with a single angle."""
    cubes = cube_estimates(ctx.products["calibrate"], "derotator")
    series = Series(
        cubes[0].nolls,
        ctx.config.turn_per_degree * np.array([cube.derotator_angle_deg for cube in cubes]),
        np.stack([cube.zernike_nm for cube in cubes]),
        np.stack([cube.covariance_nm2 for cube in cubes]),
    )
    series = series.only(usable_modes(series.nolls, ctx.config.highest_noll))
    rows = [AngleRow.filled_from(cube) for cube in cubes]
    one_angle = len(np.unique(series.angles_deg % 360)) == 1
    return _one_angle(ctx, rows, series) if one_angle else _split(ctx, rows, series)


def _one_angle(ctx: StageContext[Config], cubes: list[AngleRow], series: Series) -> StageOutput:
    """Return what there is without a second angle: the estimates as measured."""
    angle = f"derotator angle {cubes[0].derotator_angle_deg:g}°"
    reason = f"all {len(cubes)} recordings are of {angle}" if len(cubes) > 1 else f"one recording, of {angle}"
    ctx.log.warning("%s: rotating and fixed parts cannot be separated", reason)
    results = DerotatorResults(
        cubes=cubes,
        modes=list(series.nolls),
        parts=None,
        reason=reason,
        measured_nm=[_rms_nm(one) for one in series.zernike_nm],
    )
    lines = [
        f"Derotator       nothing split: {reason};",
        "  give recordings of two or more angles (derotator_angle_deg in acquisition.yaml)",
    ]
    arrays = declared(ARRAYS, _series_arrays(ctx.instrument.pupil, series))
    return StageOutput(arrays, results, summary=lines)


def _split(ctx: StageContext[Config], cubes: list[AngleRow], series: Series) -> StageOutput:
    best, other = try_both_senses(series)
    estimated = ctx.config.sense == "estimate"
    sense = 1 if ctx.config.sense == "anticlockwise" else -1
    as_set = estimated or best.sense == sense
    found = SplitOutput(series, best, other) if as_set else SplitOutput(series, other, best)
    split = found.split
    text = f"χ²/ν = {split.chi2_nu:.2f} of the two parts against the single estimates"
    checks = [Check("chi2 of the split", split.chi2_nu, "", None, ctx.config.max_chi2_nu, text)]
    if estimated:
        margin = found.delta_chi2 / max(1.0, split.chi2_nu)
        text = f"{SENSES[split.sense]} by {np.sqrt(max(margin, 0)):.1f} sigma"
        checks.append(Check("sense of rotation", margin, "", CERTAIN, None, text))
    results = DerotatorResults(cubes=cubes, **found.results())
    return StageOutput(found.arrays(ctx.instrument.pupil), results, checks, summary=found.summary())


def _rms_nm(zernike_nm: np.ndarray) -> float:
    """Return the RMS over the disc [nm]."""
    return float(np.sqrt(np.sum(zernike_nm**2)))


def map_of(geometry: PupilGeometry, nolls: Sequence[int], zernike_nm: np.ndarray) -> np.ndarray:
    """Return maps [nm] of coefficients `zernike_nm`, (..., modes `nolls`), without tip and tilt.

    `geometry` is that of the pupil.
    """
    return opd_maps_nm(nolls, zernike_nm, clear_disc(geometry, MAP_SAMPLES)).astype(np.float32)


def _series_arrays(geometry: PupilGeometry, series: Series) -> dict[str, Any]:
    return {
        "noll": series.nolls,
        "angle_deg": series.angles_deg,
        "zernike_nm": (series.zernike_nm, series.sigma_nm),
        "maps/measured_nm": map_of(geometry, series.nolls, series.zernike_nm),
    }


@dataclass(frozen=True)
class SplitOutput:
    """A split with what it was made from."""

    series: Series
    split: Split
    other: Split  # with the other sense

    @property
    def parts(self) -> dict[str, Part]:
        return {name: getattr(self.split, name) for name in PARTS}

    @property
    def delta_chi2(self) -> float:
        """χ² of the other sense minus that of the one adopted; negative against a sense that was set."""
        return self.other.chi2 - self.split.chi2

    def results(self) -> dict[str, Any]:
        """Return the keys of the results, but the cubes."""
        residual_nm = self.series.zernike_nm - self.split.predicted_nm
        return {
            "modes": list(self.split.nolls),
            "reason": None,
            "sense": SENSES[self.split.sense],
            "delta_chi2": self.delta_chi2,
            "chi2_nu": self.split.chi2_nu,
            "freedom": self.split.freedom,
            "parts": {name: self._part(name) for name in PARTS},
            "consistency": consistency(self.series, self.split),
            "measured_nm": [_rms_nm(one) for one in self.series.zernike_nm],
            "residual_nm": [_rms_nm(one) for one in residual_nm],
        }

    def _part(self, name: str) -> PartRow:
        part, separable = self.parts[name], self.split.separable
        own = np.flatnonzero(~separable if name == "unsplit" else separable)
        nolls = [self.split.nolls[i] for i in own]
        return PartRow.filled_from(
            part,
            zernike_nm=dict(zip(nolls, part.zernike_nm[own].tolist(), strict=True)),
            sigma_nm=dict(zip(nolls, part.sigma_nm[own].tolist(), strict=True)),
        )

    def arrays(self, geometry: PupilGeometry) -> dict[str, Quantity]:
        """Return coefficients and maps of the estimates, of the parts, and of what they leave."""
        nolls, back = self.series.nolls, self.series.turned_back(self.split.sense)
        left = self.series.zernike_nm - self.split.predicted_nm
        values = _series_arrays(geometry, self.series) | {
            "turned_back_nm": (back.zernike_nm, back.sigma_nm),
            "maps/turned_back_nm": map_of(geometry, nolls, back.zernike_nm),
            "maps/residual_nm": map_of(geometry, nolls, left),
        }
        for name, part in self.parts.items():
            values[f"{name}_nm"] = part.zernike_nm, part.sigma_nm
            values[f"maps/{name}_nm"] = map_of(geometry, nolls, part.zernike_nm)
        return declared(ARRAYS, values)

    def summary(self) -> list[str]:
        """Return lines for the terminal."""
        found = consistency(self.series, self.split)
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
