"""An ingest product of cubes at several derotator angles, and a context for the stages that work on it.

Frames are drawn from the pipeline's own model: what is tested is what stages make of estimates.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from helpers import optics_cases as cases
from helpers.recordings import recording as made
from helpers.stage_context import stage_context
from irlos_pipe.frames.recording import Detector, Recording
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.zernike import rotation_matrix
from irlos_pipe.product.product import Product
from irlos_pipe.stages.base import ModelConfig, Stage, StageOutput
from irlos_pipe.stages.ingest.stage import arrays_from_recording

WINDOW, FLUX_E, FRAMES = 40, 1e6, 36
NOLLS = tuple(range(4, 16))
ROTATING_NM = dict(zip(NOLLS, (0, 40, -30, 20, 25, -30, 15, 0, 10, -12, 14, 8), strict=True))
FIXED_NM = dict(zip(NOLLS, (50, 10, 15, -20, 10, 5, -10, 20, 0, 5, -5, 5), strict=True))


def static_nm(angle_deg: float) -> dict[int, float]:
    """The wavefront at a derotator angle; it turns clockwise."""
    turned = rotation_matrix(NOLLS, -angle_deg) @ list(ROTATING_NM.values())
    return {noll: float(value) + FIXED_NM[noll] for noll, value in zip(NOLLS, turned, strict=True)}


def recording(
    name: str, angle_deg: float, seed: int, frames: int = FRAMES, used: int | None = None
) -> Recording:
    """A cube without AO residual, of which the first frames are used."""
    zernike_nm = cases.vector(static_nm(angle_deg), NOLLS)
    image = PsfModel(cases.settings(WINDOW), NOLLS).images(zernike_nm)[0].double().numpy()
    return made(
        cases.draw_frames(image * FLUX_E, frames, seed).numpy(), name, "cube", role="derotator",
        used=np.arange(frames) < (frames if used is None else used), detector=Detector(2.0, 1.0),
        derotator_angle_deg=angle_deg,
    )  # fmt: skip


def ingest_product(recordings: Sequence[Recording]) -> Product:
    arrays = {}
    for one in recordings:
        arrays |= arrays_from_recording(one)
    rows = [{"name": one.name, "input": one.input} for one in recordings]
    return Product("ingest", arrays, {"inputs": rows})


def run_stage(stage: Stage, products: Mapping[str, Product], **settings) -> tuple[StageOutput, Product]:
    """Run a stage; returns its output and the product the pipeline would make of it."""
    config = stage.Config(**settings)
    ctx = stage_context(config, model=ModelConfig(effects=()), products=dict(products))
    output = stage.run(ctx)
    name, results = stage.Results.stage, output.results.as_json()
    return output, Product(name, output.arrays, results, config=config.model_dump())
