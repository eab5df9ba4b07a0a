"""A recording of thousands of frames through the pipeline: how much memory it takes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from astropy.io import fits

from benchmarks.frames import DIVERSITY_NM, PIXEL_SCALE_MAS, READ_NOISE_E, SAMPLES, SEED, WAVELENGTH_NM
from benchmarks.inputs import Inputs
from benchmarks.measure import stopwatch
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.pipeline import Selection, run_recipe
from irlos_pipe.recipe import load_recipe

RECIPE = SAMPLES.parent / "recipes" / "ncpa_calibration.yaml"
PEDESTAL_ADU, E_PER_ADU = 200.0, 4.0  # the brightest speckles do not saturate
ACQUISITION = {
    "role": "ncpa_calibration",
    "exposure_s": 0.1,
    "seeing_arcsec": 0.5,
    "pixel_scale_mas": PIXEL_SCALE_MAS,
    "spectrum": [{"wavelength_nm": WAVELENGTH_NM, "weight": 1.0}],
    "diversity": {"source": "lens", "zernike": DIVERSITY_NM},
    "detector": {"e_per_adu": E_PER_ADU, "read_noise_e": READ_NOISE_E},
}


def stream_10000(inputs: Inputs, count: int) -> dict:
    """Ingest and the default calibration of a cube of so many frames, files included."""
    cube = inputs.folder / "long.fits"
    write_cube(cube, inputs.frames.images_e, count)
    recipe = load_recipe(RECIPE, inputs=[f"calibration={cube}"])
    with stopwatch() as watch:
        run_recipe(recipe, inputs.folder / "long", Selection(last="calibrate"))
    _require_all_used(inputs.folder / "long", count)
    return watch.over(count)


def _require_all_used(run: Path, count: int) -> None:
    """Raise unless every frame was calibrated with: a frame that is rejected costs nothing."""
    results = json.loads((run / "results.json").read_text())
    (recording,) = results["stages"]["ingest"]["inputs"]
    if recording["frames_rejected"]:
        raise RuntimeError(f"{recording['frames_rejected']} of {count} frames were rejected")


def write_cube(path: Path, images_e: np.ndarray, count: int) -> None:
    """Repeat drawn frames with further read noise as counts of a plain FITS cube, its side-car beside it."""
    rng = np.random.default_rng(SEED)
    adu = np.empty((count, *images_e.shape[1:]), np.uint16)
    for number in range(count):
        noisy_e = images_e[number % len(images_e)] + rng.normal(0.0, READ_NOISE_E, images_e.shape[1:])
        adu[number] = np.rint(noisy_e / E_PER_ADU + PEDESTAL_ADU).clip(0, 65535)
    fits.PrimaryHDU(adu).writeto(path, overwrite=True)
    path.with_suffix(".yaml").write_text(yaml_text(ACQUISITION))
