"""Stage `correction_gain`: star and wavefront before and after the correction of the calibrated NCPAs."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.correction_gain.checks import checks_of
from irlos_pipe.paper.correction_gain.experiment import COMPARED, STATES, Star, correct
from irlos_pipe.paper.correction_gain.results import CorrectionGainResults as Results
from irlos_pipe.paper.correction_gain.results import SeeingRow
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAME = Results.stage
VERSION = 2
READS = ()
DEPENDS_ON = ("instrument", "seed")


class Config(StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(4, ge=1, le=1000, description="stars at each seeing; the first is drawn")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), description="seeings on SPARTA's scale")
    frames: int = Field(300, ge=10, le=10000, description="frames of the cube that is calibrated")
    star_frames: int = Field(100, ge=1, le=10000, description="frames of 0.1 s averaged to a star's image")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate, correct and image every star."""
    config = ctx.config
    stars = [_star(ctx, seeing, i) for seeing in config.seeings_arcsec for i in range(config.samples)]
    found = run_samples(correct, stars, ctx, "stars")
    by_seeing = {
        seeing: found[i * config.samples : (i + 1) * config.samples]
        for i, seeing in enumerate(config.seeings_arcsec)
    }
    rows = [_row(seeing, of_it) for seeing, of_it in by_seeing.items()]
    arrays = _arrays({seeing: of_it[0] for seeing, of_it in by_seeing.items()})
    results = Results(seeings=rows)
    return StageOutput(arrays, results, checks_of(results), summary=[_line(row) for row in rows])


def _star(ctx: StageContext[Config], seeing: float, index: int) -> Star:
    config = ctx.config
    cube = CubeSample(
        f"{seeing:g} arcsec, star {index}",
        (ctx.seed, index),
        ctx.instrument.facility,
        seeing,
        config.frames,
        config.mag_j,
    )
    return Star(cube, config.star_frames)


def _row(seeing: float, found: list[Arrays]) -> SeeingRow:
    """Medians over the stars of one seeing."""
    return SeeingRow(
        seeing_arcsec=seeing,
        samples=len(found),
        strehl={state: float(np.median([one[f"{state}/strehl"] for one in found])) for state in STATES},
        delta_wfe_nm={
            method: float(np.median([one[f"{method}/pupil_nm"] for one in found])) for method in COMPARED
        },
        won={method: float(np.median([_won(one, method) for one in found])) for method in COMPARED},
    )


def _won(star: Arrays, method: str) -> float:
    before, after, ideal = (float(star[f"{state}/strehl"]) for state in ("before", method, "ideal"))
    return (after - before) / (ideal - before)


def _arrays(drawn: dict[float, Arrays]) -> dict[str, Quantity]:
    """Images and wavefronts of the first star of every seeing."""
    arrays: dict[str, Quantity] = {}
    for seeing, star in drawn.items():
        scale = Quantity(star["pixel_scale_mas"], "mas", "pixel scale of the images")
        arrays[f"{seeing:g}/pixel_scale_mas"] = scale
        images = {f"{state}/image": "averaged star, part of the photons" for state in STATES}
        maps = {"truth_nm": "time-averaged wavefront"} | {
            f"{method}/wavefront_nm": "estimated wavefront" for method in COMPARED
        }
        for unit, names in (("1/px", images), ("nm", maps)):
            arrays |= {f"{seeing:g}/{name}": Quantity(star[name], unit, text) for name, text in names.items()}
    return arrays


def _line(row: SeeingRow) -> str:
    strehl = row.strehl
    return (
        f'{row.seeing_arcsec:4.2f}"  Strehl at 1600 nm: {strehl["before"]:.3f} before, '
        f"{strehl[PAPER_CHOICE]:.3f} with DIP global, {strehl[DEFAULT]:.3f} with the default, "
        f"{strehl['ideal']:.3f} at best"
    )
