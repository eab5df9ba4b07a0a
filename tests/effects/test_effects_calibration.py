"""Calibration with effects in the model. Truth: HCIPy images with the effect put in there (independent code)
and photon noise; Zernike coefficients of the whole wavefront by least squares on HCIPy's pupil."""

import re

import numpy as np
import pytest
import torch
from helpers.effect_cases import CONDITIONS, STRONG
from helpers.optics_cases import (
    DIVERSITY,
    MAS_RAD,
    NARROW_H,
    PRIOR,
    READ_NOISE,
    SCALE_MAS,
    draw_frames,
    everything,
    ncpa_nm,
    settings,
    vector,
)
from helpers.paths import REPOSITORY
from helpers.reference_psf import reference
from test_effects_images import petal_of, xy_m

from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf import PsfModel

pytestmark = pytest.mark.slow
WINDOW, LAST, FLUX_E, COUNT = (40, 40), 21, 1e6, 12
SAMPLES = 512  # of HCIPy's pupil; noise is more than what more would change
NCPA_NM = ncpa_nm(11, LAST, 80.0)
TILT_NM_PER_MAS = MAS_RAD * 8.0 / 4 * 1e9


def hcipy_image(extra_nm: np.ndarray | float = 0.0) -> np.ndarray:
    total = {n: NCPA_NM.get(n, 0.0) + DIVERSITY.get(n, 0.0) for n in {*NCPA_NM, *DIVERSITY}}
    imager = reference(SAMPLES)
    return imager.image(imager.opd_nm(total) + extra_nm, NARROW_H[0][0], WINDOW, SCALE_MAS)


def calibrated(means: np.ndarray, *names: str, darker_than: float = np.inf, **options) -> Calibration:
    """Calibration of noisy frames about the means (rows, columns), or (frames, rows, columns).

    Pixels that are not `darker_than` a part of the peak are masked, as clipped ones are.
    """
    images = draw_frames(np.asarray(means) * FLUX_E, COUNT, seed=4)
    mean = np.asarray(means).reshape(-1, *WINDOW).mean(axis=0)
    good = everything(images) & torch.as_tensor(mean < darker_than * mean.max())
    effects = [CATALOGUE[name].under(CONDITIONS, **options) for name in names]
    choice = CalibrationOptions(highest_noll=LAST, prior=PRIOR)
    return calibrate(Frames(images, good, READ_NOISE), settings(WINDOW), choice, effects)


def error_nm(result: Calibration, true_nm: dict[int, float]) -> float:
    return float(np.linalg.norm(result.zernike_nm - [true_nm[noll] for noll in result.nolls]))


def modes_of(opd_nm: np.ndarray) -> dict[int, float]:
    """Least-squares coefficients over the pupil, piston fitted along."""
    imager = reference(SAMPLES)
    basis = np.stack([imager.opd_nm({noll: 1.0}) for noll in range(1, LAST + 1)])
    weight = imager.transmission
    solution = np.linalg.solve((basis * weight) @ basis.T, (basis * weight) @ opd_nm)
    return dict(zip(range(2, LAST + 1), solution[1:], strict=True))


def test_two_companions_are_found_by_name_and_no_longer_spoil_the_ncpas():
    imager = reference(SAMPLES)
    true = [
        {"flux_ratio": 0.06, "sep_mas": 110.0, "pa_deg": 220.0},
        {"flux_ratio": 0.03, "sep_mas": 95.0, "pa_deg": 40.0},
    ]
    image = hcipy_image()
    for one in true:
        angle, shift_nm = np.deg2rad(one["pa_deg"]), one["sep_mas"] * TILT_NM_PER_MAS
        tilt_nm = imager.opd_nm({2: shift_nm * np.cos(angle), 3: shift_nm * np.sin(angle)})
        image = image + one["flux_ratio"] * hcipy_image(tilt_nm)
    without, result = calibrated(image / 1.09), calibrated(image / 1.09, "companion", "companion")
    assert list(result.effects) == ["companion", "companion_2"]
    for found, wanted in zip(result.effects.values(), true, strict=True):
        assert found == pytest.approx(wanted, rel=0.02)
    assert error_nm(result, NCPA_NM) < 1.0 < 5.0 < error_nm(without, NCPA_NM)
    assert result.chi2_nu < 1.3 < 10 < without.chi2_nu


def test_with_petals_in_the_model_the_modes_are_those_of_the_whole_wavefront():
    (x, y), effect = xy_m(SAMPLES), STRONG["low_wind_effect"]
    piston, tip, tilt = (0.5 * np.array(effect[key])[petal_of(x, y)] for key in effect)
    petals_nm = piston + 2 / 4.0 * (tip * x + tilt * y)
    added = modes_of(petals_nm)
    true_nm = {noll: NCPA_NM[noll] + added[noll] for noll in added}
    result = calibrated(hcipy_image(petals_nm), "low_wind_effect")
    assert error_nm(result, true_nm) < 1.5
    assert error_nm(result, NCPA_NM) > 20
    assert result.chi2_nu < 1.3
    assert np.linalg.norm(result.fitted_modes_nm - result.zernike_nm) > 20


def test_a_drift_is_measured_in_the_frames_with_its_sign():
    drift_nm = {4: -60.0, 7: 40.0}
    change = reference(SAMPLES).opd_nm(drift_nm)
    means = [hcipy_image(t * change) for t in np.linspace(-0.5, 0.5, COUNT)]
    result = calibrated(means, "ncpa_drift", nolls=[4, 7, 8])
    found = result.effects["ncpa_drift"]["zernike_nm"]
    assert [found[n] for n in ("4", "7", "8")] == pytest.approx([-60, 40, 0], abs=4)
    assert error_nm(result, NCPA_NM) < 1.5


@pytest.mark.parametrize("name", ["companion", "phase_bump", "vibration"])
def test_what_is_not_there_is_not_found(name):
    result = calibrated(hcipy_image(), name)
    size = {"companion": ("flux_ratio", 2e-3), "phase_bump": ("nm", 10.0), "vibration": ("sigma_mas", 1.5)}
    key, limit = size[name]
    assert abs(result.effects[name][key]) < limit
    assert error_nm(result, NCPA_NM) < 1.5


@pytest.mark.parametrize("darker_than", [1.0, 0.6])
def test_a_bent_response_is_found_without_the_brightest_pixels(darker_than):
    """The loss is stated at the brightest pixel of the model, which these frames may not show."""
    image = hcipy_image()
    bent = image * (1 - 0.08 * image / image.max())
    result = calibrated(bent, "detector_nonlinearity", darker_than=darker_than)
    found = result.effects["detector_nonlinearity"]["fraction_at_peak"]
    assert found == pytest.approx(0.08, abs=0.005)
    assert error_nm(result, NCPA_NM) < 1.0


# The worked example of docs/extending.md is run.
# Truth of the example: finite differences, and its own image.


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
