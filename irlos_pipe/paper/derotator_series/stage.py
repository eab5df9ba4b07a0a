"""Stage `derotator_series`: the paper's derotator test on simulated cubes, with known truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.estimate.derotator import Series, try_both_senses, usable_modes
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.seeing import on_spartas_scale
from irlos_pipe.paper.common.variants import frames_per_method
from irlos_pipe.paper.derotator_series.checks import checks_of
from irlos_pipe.paper.derotator_series.experiment import (
    AngleSample,
    Truth,
    draw_truth,
    estimate,
    rms_beyond_tilt_nm,
    split_errors,
)
from irlos_pipe.paper.derotator_series.results import DerotatorSeriesResults as Results
from irlos_pipe.paper.derotator_series.results import MethodRow, PartsWfe
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.derotator import SplitOutput, map_of

NAME = Results.stage
VERSION = 4
READS = ()
DEPENDS_ON = ("instrument", "seed")


class Config(StageConfig):
    """Sizes of the experiment."""

    angles_deg: tuple[float, ...] = Field(
        (0, 23, 46, 69, 92, 115, 138, 161, 180), min_length=2, description="derotator angles"
    )
    frames: int = Field(600, ge=10, le=10000, description="frames of a cube")
    published_frames: int = Field(
        100, ge=2, le=10000, description="the first frames, for the published method, which fits one by one"
    )
    seeing_arcsec: float = Field(1.2, gt=0, le=5, description="seeing by MASS-DIMM, as the paper has it")
    mag_j: float = Field(8.0, ge=0, le=20, description="J magnitude of the star")
    rotating_nm: float = Field(50.0, ge=0, description="random NCPAs before the derotator, beside the bump")
    fixed_nm: float = Field(100.0, ge=0, description="random NCPAs behind it")

    @property
    def method_frames(self) -> dict[str, int]:
        """Return the frames that every method is given."""
        return frames_per_method(self.frames, self.published_frames)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate and calibrate the cube of every angle, and split the estimates of every method."""
    config = ctx.config
    truth = draw_truth((ctx.seed,), ctx.instrument.facility.ncpa_law, config.rotating_nm, config.fixed_nm)
    found = run_samples(estimate, list(_samples(ctx, truth)), ctx, "angles")
    splits = {method: _split(config, found, method) for method in config.method_frames}
    arrays = _truth_arrays(ctx, truth, found)
    for method, split in splits.items():
        own = split.arrays(ctx.instrument.pupil)
        arrays |= {f"{method}/{name}": quantity for name, quantity in own.items()}
    rows = {method: _row(split, truth, found, method) for method, split in splits.items()}
    results = Results(
        angles_deg=list(config.angles_deg),
        frames=config.method_frames,
        truth=PartsWfe(
            rotating_nm=rms_beyond_tilt_nm(truth.rotating_nm), fixed_nm=rms_beyond_tilt_nm(truth.fixed_nm)
        ),
        methods=rows,
    )
    lines = [line for method, row in rows.items() for line in _lines(method, row)]
    return StageOutput(arrays, results, checks_of(results), summary=lines)


def _samples(ctx: StageContext[Config], truth: Truth) -> Iterator[AngleSample]:
    for index, angle in enumerate(ctx.config.angles_deg):
        yield AngleSample(
            f"{angle:g} deg",
            (ctx.seed, 1, index),
            ctx.instrument.facility,
            truth,
            angle,
            ctx.config.method_frames,
            on_spartas_scale(ctx.instrument, ctx.config.seeing_arcsec),
            ctx.config.mag_j,
        )


def _split(config: Config, found: Sequence[Arrays], method: str) -> SplitOutput:
    series = Series(
        tuple(int(noll) for noll in found[0][f"{method}/noll"]),
        np.array(config.angles_deg, dtype=float),
        np.stack([one[f"{method}/zernike_nm"] for one in found]),
        np.stack([one[f"{method}/covariance_nm2"] for one in found]),
    )
    series = series.only(usable_modes(series.nolls))
    senses = try_both_senses(series)
    return SplitOutput(series, senses.best, senses)


def _row(split: SplitOutput, truth: Truth, found: Sequence[Arrays], method: str) -> MethodRow:
    """The split, its errors and those of the single estimates."""
    return MethodRow(
        **split.results(),
        errors=split_errors(split.series, split.split, truth),
        delta_nm=[float(one[f"{method}/delta_nm"]) for one in found],
        calibration_chi2_nu=[float(one[f"{method}/chi2_nu"]) for one in found],
    )


def _truth_arrays(ctx: StageContext[Config], truth: Truth, found: Sequence[Arrays]) -> dict[str, Quantity]:
    pupil = ctx.instrument.pupil
    arrays: dict[str, Quantity] = {}
    for name, part_nm in (("rotating", truth.rotating_nm), ("fixed", truth.fixed_nm)):
        seen = {noll: value for noll, value in part_nm.items() if noll > 3}
        map_nm = map_of(pupil, list(seen), np.array(list(seen.values())))
        arrays[f"truth/maps/{name}_nm"] = Quantity(map_nm, "nm", "simulated, without tip and tilt")
    arrays["mean_image_e"] = Quantity(np.stack([one["mean_image_e"] for one in found]), "e-", "of a frame")
    return arrays


def _lines(method: str, row: MethodRow) -> list[str]:
    errors, parts = row.errors, row.parts or {}
    rotating, fixed = (parts[name].rms_nm for name in ("rotating", "fixed"))
    return [
        f"{method:15s} {rotating:.0f} nm turn, {fixed:.0f} nm do not; "
        f"wrong by {errors.rotating_nm:.1f} and {errors.fixed_nm:.1f} nm in Noll 4–30",
        f"  Δ-WFE of single angles {np.median(row.delta_nm):.1f} nm, median; sense {row.sense} "
        f"(Δχ² {row.delta_chi2:.0f}), χ²/ν {row.chi2_nu:.2f}",
    ]
