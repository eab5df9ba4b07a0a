"""Stage `mirror_loop`: NCPAs corrected by a deformable mirror until nothing improves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.mirror_loop.checks import checks_of
from irlos_pipe.paper.mirror_loop.experiment import (
    LOOPS,
    PARTS,
    SERIES,
    Loop,
    MirrorErrors,
    MirrorSample,
    close,
    improves,
)
from irlos_pipe.paper.mirror_loop.results import AloneRow, LoopRow, StateRow
from irlos_pipe.paper.mirror_loop.results import MirrorLoopResults as Results
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 1
READS = ()
DEPENDS_ON = ("instrument", "seed")
ASKED_NM = 10.0  # of the default with a diversity that is as declared, in Noll 4–30


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs")
    biases_nm: tuple[float, ...] = Field(
        (0.0, 200.0, -200.0), min_length=1, description="defocus; 0 is a star that was refocused [nm RMS]"
    )
    frames: int = Field(60, ge=10, le=10000, description="frames of a cube")
    star_frames: int = Field(20, ge=1, le=10000, description="frames of 0.1 s averaged to a star's image")
    corrections: int = Field(6, ge=1, le=50, description="most corrections of a loop")
    pitches_m: tuple[float, ...] = Field(
        (0.22, 1.0), min_length=1, description="from actuator to actuator; the first is that of the loops [m]"
    )
    gain: float = Field(0.9, gt=0, lt=2, description="stroke of the mirror over the stroke asked for")
    shift: float = Field(0.03, ge=0, le=0.2, description="of the mirror, over the diameter of the pupil")
    turn_deg: float = Field(1.0, ge=-45, le=45, description="angle by which the mirror is turned [deg]")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")

    @property
    def errors(self) -> MirrorErrors:
        """Return how the mirror differs from the one that is believed in."""
        return MirrorErrors(self.gain, self.shift, self.turn_deg)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Close all loops."""
    config = ctx.config
    samples = [_sample(ctx, bias_nm, i) for bias_nm in config.biases_nm for i in range(config.samples)]
    found = run_samples(close, samples, ctx, "stars and mirrors")
    rows = [
        _row(loop, bias_nm, _of(samples, found, bias_nm)) for loop in LOOPS for bias_nm in config.biases_nm
    ]
    alone = [
        _alone(samples[0], found, pitch_m, error)
        for pitch_m in config.pitches_m
        for error in config.errors.alone()
    ]
    results = Results(samples=config.samples, rows=rows, alone=alone)
    return StageOutput(_arrays(found), results, checks_of(results), summary=[_line(row) for row in rows])


def _sample(ctx: StageContext[Config], bias_nm: float, index: int) -> MirrorSample:
    config = ctx.config
    return MirrorSample(
        f"bias {bias_nm:g} nm, NCPAs {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        bias_nm,
        config.frames,
        config.star_frames,
        config.corrections,
        config.seeing_arcsec,
        config.mag_j,
        config.pitches_m,
        config.errors,
    )


def _of(samples: Sequence[MirrorSample], found: Sequence[Arrays], bias_nm: float) -> list[Arrays]:
    return [one for sample, one in zip(samples, found, strict=True) if sample.bias_nm == bias_nm]


def _row(loop: Loop, bias_nm: float, found: Sequence[Arrays]) -> LoopRow:
    done = np.array([int(one[f"{loop.name}/corrections"]) for one in found])
    series = {name: np.array([one[f"{loop.name}/{name}"] for one in found]) for name in SERIES}
    first = {name: Percentiles.of(values[:, 0]) for name, values in series.items()}
    last = {name: values[np.arange(len(found)), done] for name, values in series.items()}
    part_nm, part_beyond_nm = (
        {part: float(np.median([one[f"{loop.name}/{part}/{where}"] for one in found])) for part in PARTS}
        for where in ("modes_nm", "beyond_nm")
    )
    falling = [improves(one) for one in series["seen_nm"]]
    asked = loop.method == DEFAULT and loop.diversity == "exact"
    return LoopRow(
        method=loop.method,
        diversity=loop.diversity,
        bias_nm=bias_nm,
        introduced_nm=first["all_nm"],
        states=[_state(series, index) for index in range(done.max() + 1)],
        corrections=Percentiles.of(done),
        most_corrections=int(done.max()),
        cut_off=sum(falling),
        before_nm=first["modes_nm"],
        end_nm=Percentiles.of(last["modes_nm"]),
        beyond_nm=Percentiles.of(last["beyond_nm"]),
        all_nm=Percentiles.of(last["all_nm"]),
        strehl_before=first["strehl"],
        strehl_end=Percentiles.of(last["strehl"]),
        strehl_ideal=Percentiles.of([float(one["ideal"]) for one in found]),
        strehl_predicted=Percentiles.of([float(one[f"{loop.name}/predicted"]) for one in found]),
        part_nm=part_nm,
        part_beyond_nm=part_beyond_nm,
        limit=max(part_nm, key=lambda part: part_nm[part]),
        asked_nm=ASKED_NM if asked else float("nan"),
        worst_nm=float(last["modes_nm"].max()),
    )


def _state(series: Mapping[str, np.ndarray], index: int) -> StateRow:
    there = np.isfinite(series["modes_nm"][:, index])
    spreads = {name: Percentiles.of(values[there, index]) for name, values in series.items()}
    return StateRow(corrections=index, samples=int(there.sum()), **spreads)


def _alone(sample: MirrorSample, found: Sequence[Arrays], pitch_m: float, error: str) -> AloneRow:
    key = f"alone/{pitch_m:g}/{error}"
    actuators = sample.mirror(pitch_m, sample.errors).actuators
    return AloneRow(
        pitch_m=pitch_m,
        actuators=int(actuators.present.sum()),
        error=error,
        modes_nm=np.median([one[f"{key}/modes_nm"] for one in found], axis=0).tolist(),
        beyond_nm=float(np.median([one[f"{key}/beyond_nm"][-1] for one in found])),
    )


def _arrays(found: Sequence[Arrays]) -> dict[str, Quantity]:
    return {
        key: Quantity(
            np.array([one[key] for one in found]), "nm" if key.endswith("_nm") else "", "per sample"
        )
        for key in found[0]
    }


def _line(row: LoopRow) -> str:
    return (
        f"{row.method}, {row.diversity} diversity, bias {row.bias_nm:g} nm: {row.before_nm.median:.0f} → "
        f"{row.end_nm.median:.1f} nm in Noll 4–30 after {row.corrections.median:g} corrections, Strehl "
        f"{row.strehl_before.median:.3f} → {row.strehl_end.median:.3f} of {row.strehl_ideal.median:.3f}; "
        f"limited by {row.limit}"
    )
