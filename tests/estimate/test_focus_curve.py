"""χ² against defocus. Truth: a pupil with symmetry about its centre gives ±d one image; minima by SciPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from scipy.optimize import minimize

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.tabulated import CURVE_NM, FocusCurve, focus_curve
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

WINDOW = (40, 40)
GOOD, NOISE = torch.ones(WINDOW, dtype=torch.bool), NoiseModel(1.0, 1.0)
FLUX_E = 3e4


def model(diversity_nm: float) -> ImageModel:
    """Without vanes: those of the telescope are not the same upside down."""
    settings = cases.settings(WINDOW, ((1625.0, 1.0),), {6: diversity_nm} if diversity_nm else {})
    round_pupil = replace(settings.geometry, vanes=())
    return ImageModel(PsfModel(replace(settings, geometry=round_pupil).for_single_frames(), (2, 3, 4)))


def image(of: ImageModel, focus_nm: float, seed: int | None = None) -> torch.Tensor:
    mean_e = FLUX_E * of.psf.images(torch.tensor([[20.0, -30.0, focus_nm]])).double()[0].clamp_min(0)
    return mean_e if seed is None else torch.poisson(mean_e, torch.Generator().manual_seed(seed))


def curve(of: ImageModel, image_e: torch.Tensor, start_nm: float) -> FocusCurve:
    start = torch.tensor([[20.0, -30.0, start_nm]], dtype=torch.float64)
    best = lift(of, image_e[None], GOOD, NOISE, start).zernike_nm[0]
    return focus_curve(of, image_e, GOOD, NOISE, best)


def test_without_diversity_the_twin_fits_as_well_as_the_truth():
    of = model(0.0)
    found = curve(of, image(of, 200.0), 230.0)
    assert found.best_nm == pytest.approx(200.0, abs=0.1) and found.twin_nm == pytest.approx(-200.0, abs=0.1)
    assert abs(found.delta_chi2) < 1e-3
    np.testing.assert_allclose(found.chi2_nu, found.chi2_nu[::-1], rtol=1e-3, atol=1e-4)


def test_with_diversity_the_twin_is_excluded_and_lies_where_a_direct_search_finds_it():
    """The search: likelihood of the pixels, minimised by SciPy's simplex for a given start."""
    of = model(-30.0)
    image_e = image(of, 150.0, seed=3)
    found = curve(of, image_e, 150.0)

    def minus_twice_the_likelihood(x: np.ndarray) -> float:
        flux_e, background_e, *modes_nm = x
        mean_e = flux_e * of.psf.images(torch.tensor([modes_nm]))[0].double() + background_e
        shifted = (mean_e + 1).clamp_min(1e-3)  # read noise of 1 e⁻ as a further electron of background
        return float(2 * (shifted - (image_e + 1) * shifted.log()).sum())

    def lowest_from(focus_nm: float):
        start = np.array([FLUX_E, 0.0, 20.0, -30.0, focus_nm])
        steps = start + np.diag([3000.0, 1.0, 20.0, 20.0, 40.0])
        simplex = {"initial_simplex": [start, *steps], "maxiter": 1500, "xatol": 1e-2, "fatol": 1e-3}
        return minimize(minus_twice_the_likelihood, start, method="Nelder-Mead", options=simplex)

    best, twin = lowest_from(150.0), lowest_from(found.twin_nm)
    assert best.x[-1] == pytest.approx(found.best_nm, abs=0.5)
    assert twin.x[-1] == pytest.approx(found.twin_nm, abs=1.0)
    assert found.delta_chi2 == pytest.approx(twin.fun - best.fun, rel=0.02)
    assert found.evidence > 100


def test_misfit_counts_as_noise_and_without_a_twin_there_is_no_evidence():
    one = FocusCurve(CURVE_NM, CURVE_NM**2, 0.0, best_chi2_nu=4.0, twin_nm=300.0, delta_chi2=20.0)
    assert one.evidence == 5.0 and replace(one, best_chi2_nu=0.6).evidence == 20.0
    assert np.isnan(FocusCurve(CURVE_NM, CURVE_NM**2, 0.0, 1.0).evidence)
