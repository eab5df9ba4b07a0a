"""Stage `low_wind`: calibrations beside petals out of step, with and without them in the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.low_wind.checks import checks_of
from irlos_pipe.paper.low_wind.experiment import (
    BROAD,
    NARROW,
    WITH,
    WITHOUT,
    LowWindSample,
    Recording,
    estimate,
)
from irlos_pipe.paper.low_wind.results import LowWindResults as Results
from irlos_pipe.paper.low_wind.results import LowWindRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 4
READS = ()
DEPENDS_ON = ("instrument", "seed")
ASKED_NM = 10.0  # of a calibration that has the petals in its model
NUMBERS = ("pupil_nm", "folded_nm", "modes_nm", "chi2_nu")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(2, ge=1, le=1000, description="sets of NCPAs and patterns of petals")
    sizes_nm: tuple[float, ...] = Field(
        (0.0, 100.0, 200.0, 400.0), min_length=1, description="pistons [nm RMS over the petals]"
    )
    short_s: float = Field(0.1, gt=0, le=10, description="exposure of short frames [s]")
    long_s: float = Field(1.0, gt=0, le=10, description="exposure of long frames [s]")
    total_s: float = Field(10.0, gt=0, description="exposure of a whole cube [s]")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Return one band with short and with long exposures, and two bands with short ones."""
        return (
            Recording(NARROW, self.short_s),
            Recording(NARROW, self.long_s),
            Recording(BROAD, self.short_s),
        )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Simulate and calibrate all cubes."""
    samples = [_sample(ctx, index) for index in range(ctx.config.samples)]
    found = run_samples(estimate, samples, ctx, "patterns of petals")
    rows = [
        _row(samples, found, recording, size_nm, model)
        for recording in ctx.config.recordings
        for size_nm in ctx.config.sizes_nm
        for model in (WITHOUT, WITH)
    ]
    results = Results(samples=len(samples), rows=rows)
    return StageOutput(
        _arrays(samples, found), results, checks_of(results), summary=[_line(row) for row in rows]
    )


def _sample(ctx: StageContext[Config], index: int) -> LowWindSample:
    config = ctx.config
    return LowWindSample(
        f"petals {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        config.sizes_nm,
        config.recordings,
        config.total_s,
        config.seeing_arcsec,
        config.mag_j,
    )


def _row(
    samples: Sequence[LowWindSample],
    found: Sequence[Arrays],
    recording: Recording,
    size_nm: float,
    model: str,
) -> LowWindRow:
    key = f"{recording.name}/{size_nm:g}"
    values = {name: np.array([float(one[f"{key}/{model}/{name}"]) for one in found]) for name in NUMBERS}
    limited = values["folded_nm" if recording.band == NARROW else "pupil_nm"]
    return LowWindRow(
        recording=recording.name,
        size_nm=size_nm,
        largest_difference_nm=Percentiles.of([size_nm * float(np.ptp(one.pattern)) for one in samples]),
        introduced_nm=Percentiles.of([float(one[f"{key}/introduced_nm"]) for one in found]),
        model=model,
        asked_nm=ASKED_NM if model == WITH else float("nan"),
        worst_nm=float(limited.max()),
        **{name: Percentiles.of(of_it) for name, of_it in values.items()},
    )


def _arrays(samples: Sequence[LowWindSample], found: Sequence[Arrays]) -> dict[str, Quantity]:
    arrays = {
        key: Quantity(
            np.array([float(one[key]) for one in found]), "nm" if key.endswith("_nm") else "", "per sample"
        )
        for key in found[0]
    }
    patterns = np.array([one.pattern for one in samples])
    return arrays | {"pattern": Quantity(patterns, "", "pistons over their RMS (sample, petal)")}


def _line(row: LowWindRow) -> str:
    return (
        f"{row.recording}, {row.size_nm:g} nm, {row.model} petals: {row.pupil_nm.median:.1f} nm, "
        f"whole waves apart {row.folded_nm.median:.1f} nm, worst {row.worst_nm:.1f} nm"
    )
