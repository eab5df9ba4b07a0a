"""The worked example of docs/extending.md is run, and the page that lists all effects is that of the classes.

Truth of the example: finite differences, and its own image.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from helpers.optics_cases import PRIOR, READ_NOISE, draw_frames, everything, ncpa_nm, settings, vector
from helpers.paths import REPOSITORY

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf import PsfModel

TEXT = (REPOSITORY / "docs" / "extending.md").read_text()
NOLLS = tuple(range(2, 12))
ONE, NONE = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
SPOT = torch.tensor([0.5, -1.6, 1.2], dtype=torch.float64)


@pytest.fixture(scope="module")
def dark_spot():
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", TEXT, re.S) if "class DarkSpot" in c)
    assert len(code.splitlines()) <= 30
    names: dict = {}
    exec(code, names)
    return names["DarkSpot"]()


@pytest.fixture(scope="module")
def psf() -> PsfModel:
    return PsfModel(settings((32, 32)), NOLLS, dtype=torch.float64)


def test_the_example_takes_away_the_light_of_the_spot(dark_spot, psf):
    at = torch.zeros(1, len(NOLLS)).double(), ONE, NONE
    whole = PsfModel(settings((120, 120)), NOLLS, dtype=torch.float64)
    left, all_of_it = ImageModel(whole, [dark_spot]).predict(*at, SPOT), ImageModel(whole).predict(*at)
    lost = 1 - float(left.sum() / all_of_it.sum())
    area = np.pi * 0.3**2 * (2 * 2 * 0.5 - 0.5**2)  # ∫ 1 - (1 - d exp(-½ r²/s²))²
    clear = np.pi * (4.0**2 - 0.558**2) - 4 * 0.04 * 3.3
    assert lost == pytest.approx(area / clear, rel=0.05)


@pytest.mark.slow
def test_the_example_is_searched_for_and_fitted(dark_spot, psf):
    true_nm = ncpa_nm(3, 11, 60.0)
    mean = ImageModel(psf, [dark_spot]).predict(vector(true_nm, NOLLS), 3e6 * ONE, NONE, SPOT)[0].numpy()
    images = draw_frames(mean, 20, seed=8)
    cube = Frames(images, everything(images), READ_NOISE)
    result = calibrate(
        cube, settings((32, 32)), CalibrationOptions(highest_noll=11, prior=PRIOR), [dark_spot]
    )
    assert list(result.effect_values["dark_spot"]) == pytest.approx(SPOT.tolist(), rel=0.05)
    assert result.chi2_nu < 1.3
