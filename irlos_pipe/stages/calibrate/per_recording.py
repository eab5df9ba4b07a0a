"""What stage `calibrate` reports when every recording is reduced by itself.

The keys of a joint estimate hold the mean over the cubes; those of every cube stand in
``cubes``, its arrays under ``cubes/<name>/``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from irlos_pipe.effects.public_values import mean_of
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.frames.recording import Acquisition
from irlos_pipe.product.product import Quantity, declared
from irlos_pipe.stages.base import StageOutput
from irlos_pipe.stages.calibrate.output import (
    arrays_of,
    by_noll,
    counts,
    effect_lines,
    estimate_keys,
    not_told,
    reported,
    wfe_nm,
)
from irlos_pipe.stages.calibrate.quality import Limits, checks_of
from irlos_pipe.stages.calibrate.results import ARRAYS, CUBES, CalibrateResults, CubeRow
from irlos_pipe.stages.model.untested import CUBES_IN_SHORT, untested_by_cubes


@dataclass(frozen=True)
class Cube:
    """One recording and what was estimated from it."""

    name: str
    acquisition: Acquisition
    seeing_arcsec: float
    result: Calibration


def each_output(limits: Limits, cubes: Sequence[Cube], failures: Sequence[str]) -> StageOutput:
    """Return the output of one estimate per recording.

    Parameters
    ----------
    limits : Limits
    cubes : sequence of Cube
    failures : sequence of str
        One line per recording that could not be used.
    """
    mean = _Mean(cubes)
    arrays = mean.arrays()
    for cube in cubes:
        arrays |= arrays_of(cube.result, f"{CUBES}/{cube.name}/")
    why = [not_told(cube.result) for cube in cubes]
    results = CalibrateResults(
        **mean.results(),
        cubes=[_row(cube) for cube in cubes],
        untested=untested_by_cubes(cubes[0].acquisition.diversity, next(filter(None, why), "")),
    )
    checks = [check for cube in cubes for check in checks_of(limits, cube.result, f"{cube.name}: ")]
    return StageOutput(arrays, results, checks, summary=_summary(mean, cubes), failures=failures)


def _row(cube: Cube) -> CubeRow:
    angle_deg = cube.acquisition.derotator_angle_deg
    return CubeRow(
        name=cube.name,
        derotator_angle_deg=angle_deg,
        **estimate_keys(cube.result),
        effects=cube.result.effects,
    )


class _Mean:
    """Plain mean over the cubes, which count alike however bright they are, of the modes that all have."""

    def __init__(self, cubes: Sequence[Cube]) -> None:
        self.all = [cube.result for cube in cubes]
        self.first = min(self.all, key=lambda one: len(one.nolls))
        self.nolls = self.first.nolls
        own = slice(len(self.nolls))
        self.zernike_nm = np.mean([one.zernike_nm[own] for one in self.all], axis=0)
        self.modes_nm = np.mean([one.fitted_modes_nm[own] for one in self.all], axis=0)
        covariances_nm2 = [one.covariance_nm2[own, own] for one in self.all]
        self.covariance_nm2 = np.sum(covariances_nm2, axis=0) / len(self.all) ** 2
        self.sigma_nm = np.sqrt(np.diag(self.covariance_nm2))
        self.seeing_arcsec = float(np.mean([cube.seeing_arcsec for cube in cubes]))
        self.wavelength_nm = float(np.mean([cube.acquisition.wavelength_nm for cube in cubes]))
        self.effects = mean_of([one.effects for one in self.all])

    def arrays(self) -> dict[str, Quantity]:
        values = {
            "noll": self.nolls,
            "zernike_nm": (self.zernike_nm, self.sigma_nm),
            "modes_nm": self.modes_nm,
            "covariance_nm2": self.covariance_nm2,
        }
        for name in self.first.effect_values:
            values[f"effects/{name}"] = np.mean([one.effect_values[name] for one in self.all], axis=0)
        return declared(ARRAYS, values, "mean over the cubes")

    def results(self) -> dict[str, Any]:
        return estimate_keys(self.first) | {
            "zernike_nm": by_noll(self.nolls, self.zernike_nm),
            "all_zernike_nm": dict(zip(self.nolls, self.zernike_nm.tolist(), strict=True)),
            "tail": None,
            "sigma_nm": by_noll(self.nolls, self.sigma_nm),
            "wfe_nm": wfe_nm(self.nolls, self.zernike_nm),
            "wfe_sigma_nm": wfe_nm(self.nolls, self.sigma_nm),
            "frames": sum(len(one.frames_nm) for one in self.all),
            "seconds": round(sum(one.seconds for one in self.all), 3),
            "chi2_nu": float(np.mean([one.chi2_nu for one in self.all])),
            "nominal_chi2_nu": float(np.mean([one.nominal.value for one in self.all])),
            "nominal_chi2_nu_sigma": float(np.mean([one.nominal.sigma for one in self.all])),
            "status": counts([status for one in self.all for status in one.frame_status]),
            "effects": self.effects,
            "seeing_arcsec": self.seeing_arcsec,
            "wavelength_nm": self.wavelength_nm,
            "twin": None,
            "compare": [],
        }


def _summary(mean: _Mean, cubes: Sequence[Cube]) -> list[str]:
    last = mean.nolls[reported(mean.nolls)][-1]
    return [
        f"NCPA            {wfe_nm(mean.nolls, mean.zernike_nm):.1f} ± "
        f"{wfe_nm(mean.nolls, mean.sigma_nm):.1f} nm RMS in Noll 2–{last}: mean of {len(cubes)} "
        f"{'cube' if len(cubes) == 1 else 'cubes'} ({mean.first.options.method})",
        *effect_lines(mean.effects),
        *(
            f"  {cube.name}: {wfe_nm(mean.nolls, cube.result.zernike_nm):.1f} nm RMS, derotator "
            f"{cube.acquisition.derotator_angle_deg:g}°, χ²/ν {cube.result.chi2_nu:.2f}"
            for cube in cubes
        ),
        CUBES_IN_SHORT,
    ]
