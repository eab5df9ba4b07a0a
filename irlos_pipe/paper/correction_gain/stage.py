"""Stage `correction_gain`: star and wavefront before and after the correction of the calibrated NCPAs."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.correction_gain.experiment import Star, correct
from irlos_pipe.paper.methods.experiment import Sample
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = "correction_gain"
VERSION = 1
READS = ()
DEPENDS_ON = ("instrument", "seed")
VARIANTS = (DEFAULT, "dip_global")
STATES = ("before", *VARIANTS, "ideal")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(4, ge=1, le=1000, description="stars at each seeing; the first is drawn")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0))
    frames: int = Field(300, ge=10, le=10000, description="frames of the cube that is calibrated")
    star_frames: int = Field(100, ge=1, le=10000, description="frames of 0.1 s averaged to a star's image")
    mag_j: float = Field(7.0, ge=0, le=20)


def run(ctx: StageContext) -> StageOutput:
    """Calibrate, correct and image every star."""
    stars = [
        _star(ctx, seeing, index)
        for seeing in ctx.config.seeings_arcsec
        for index in range(ctx.config.samples)
    ]
    numbers = run_samples(correct, stars, ctx, "stars")
    seeings = [
        _of_seeing(
            seeing, [n for s, n in zip(stars, numbers, strict=True) if s.sample.seeing_arcsec == seeing]
        )
        for seeing in ctx.config.seeings_arcsec
    ]
    drawn = {
        seeing: numbers[place * ctx.config.samples] for place, seeing in enumerate(ctx.config.seeings_arcsec)
    }
    return StageOutput(_arrays(drawn), {"seeings": seeings}, summary=[_line(row) for row in seeings])


def _star(ctx: StageContext, seeing: float, index: int) -> Star:
    config = ctx.config
    name = f"{seeing:g} arcsec, star {index}"
    sample = Sample(
        name,
        (ctx.seed, index),
        ctx.instrument.facility,
        seeing,
        "power_law",
        config.frames,
        VARIANTS,
        (),
        config.mag_j,
    )
    return Star(name, sample, config.star_frames)


def _of_seeing(seeing: float, numbers: list[Arrays]) -> dict:
    """Medians over the stars of one seeing."""
    return {
        "seeing_arcsec": seeing,
        "samples": len(numbers),
        "strehl": {state: float(np.median([n[f"{state}/strehl"] for n in numbers])) for state in STATES},
        "delta_wfe_nm": {
            variant: float(np.median([n[f"{variant}/pupil_nm"] for n in numbers])) for variant in VARIANTS
        },
        # Of the Strehl that a perfect correction would bring, the part that was won.
        "won": {variant: float(np.median([_won(n, variant) for n in numbers])) for variant in VARIANTS},
    }


def _won(numbers: Arrays, variant: str) -> float:
    before, after, ideal = (float(numbers[f"{state}/strehl"]) for state in ("before", variant, "ideal"))
    return (after - before) / (ideal - before)


def _arrays(drawn: dict[float, Arrays]) -> dict[str, Quantity]:
    """Images and wavefronts of the first star of every seeing."""
    arrays = {}
    for seeing, numbers in drawn.items():
        for state in STATES:
            arrays[f"{seeing:g}/{state}/image"] = Quantity(
                numbers[f"{state}/image"], "1/px", "averaged star, part of the photons"
            )
        arrays[f"{seeing:g}/truth_nm"] = Quantity(numbers["truth_nm"], "nm", "time-averaged wavefront")
        for variant in VARIANTS:
            arrays[f"{seeing:g}/{variant}/wavefront_nm"] = Quantity(
                numbers[f"{variant}/wavefront_nm"], "nm", "estimated wavefront"
            )
    return arrays


def _line(row: dict) -> str:
    strehl = row["strehl"]
    return (
        f'{row["seeing_arcsec"]:4.2f}"  Strehl at 1600 nm: {strehl["before"]:.3f} before, '
        f"{strehl['dip_global']:.3f} with DIP global, {strehl[DEFAULT]:.3f} with the default, "
        f"{strehl['ideal']:.3f} at best"
    )
