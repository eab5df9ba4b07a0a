"""Frames drawn from the model itself, with one effect or none: for tests of the parts of a diagnosis."""

import functools

import numpy as np
import torch

from helpers.optics_cases import (
    BAND,
    NCPA_LAW,
    READ_NOISE,
    RESIDUAL_LAW,
    draw_frames,
    everything,
    ncpa_nm,
    settings,
    vector,
)
from irlos_pipe.diagnosis.cube import Cube, Stacks, without_blocks_of_time
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import Options
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Conditions
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

WINDOW, NOLLS, FRAMES, FLUX_E = 32, tuple(range(2, 12)), 40, 3e5
CASE = settings(WINDOW, margin_mas=100.0, halo_margin_mas=250.0)
CONDITIONS = Conditions(CASE, BAND, RESIDUAL_LAW, 0.5, NOLLS[-1], ncpa_law=NCPA_LAW)
OPTIONS = Options(NOLLS[-1], held_out=0.25, most_names=4, sure=5.0)
TRUE_NM = ncpa_nm(4, NOLLS[-1], 90.0)


@functools.cache
def model() -> PsfModel:
    return PsfModel(CASE, NOLLS, dtype=torch.float64)


def image(modes_nm: dict[int, float] = TRUE_NM, effect=None, values=()) -> np.ndarray:
    return image_with([] if effect is None else [effect], modes_nm, values)


def image_with(effects, modes_nm: dict[int, float] = TRUE_NM, values=()) -> np.ndarray:
    """Mean image [e-] with some effects, and the values of what is free in them."""
    whole = ImageModel(model(), effects)
    flux, none = torch.tensor([FLUX_E], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    values = torch.tensor(values, dtype=torch.float64)
    return whole.predict(vector(modes_nm, NOLLS), flux, none, values)[0].numpy()


def frames(mean_e: np.ndarray, seed: int = 1, noise: NoiseModel = READ_NOISE) -> Frames:
    images = draw_frames(mean_e, FRAMES, seed, noise)
    return Frames(images, everything(images), READ_NOISE)


def cube(mean_e: np.ndarray, seed: int = 1) -> Cube:
    return without_blocks_of_time(frames(mean_e, seed)).limited_by(True)


def optimum(stack: Stacks, effects=()) -> Optimum:
    return Optimum(stack, fitted(stack, effects))


def fitted(stack: Stacks, effects=()) -> Fitted:
    return Fitter([View(model(), CONDITIONS)], stack).fit(effects)
