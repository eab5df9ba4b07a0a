"""What was declared wrongly is named, with the value that the data want. Truth: images of the model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.pupil_drawing import turned
from irlos_pipe.effects import Conditions
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.causes import Asked, causes_of_misfit, improbable_diversity
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.numerics.solver import solve
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.structure_function import ResidualBand

pytestmark = pytest.mark.slow
NOLLS, WINDOW, FLUX_E = tuple(range(2, 16)), 40, 1e6
SETTINGS = cases.settings(WINDOW)
PLACE = torch.tensor([[*np.linspace(30, -20, len(NOLLS)), FLUX_E, 5.0]], dtype=torch.float64)
LAW = load_instrument("irlos").facility.ncpa_law
CONDITIONS = Conditions(
    SETTINGS, ResidualBand(0.125, 2.5, 25.0), ResidualLaw(0.0, 0.0), 0.5, NOLLS[-1], ncpa_law=LAW
)


def found(settings, beside=0.0, nolls=NOLLS, cutoff=np.nan, facts_only=False):
    """Causes of the misfit of an image taken with other `settings`, and light `beside` the star in it.

    It is fitted by modes `nolls`, of which there may be more than in the light. The end of its spectrum is at
    so many times the declared `cutoff`.
    """
    truth = ImageModel(PsfModel(settings, NOLLS, dtype=torch.float64))
    image_e = truth.predict(PLACE[:, :-2], PLACE[:, -2], PLACE[:, -1], truth.effects.starts) + beside
    data = torch.poisson(image_e.clamp_min(0), generator=torch.Generator().manual_seed(1)).reshape(1, 1, -1)
    model = ImageModel(PsfModel(SETTINGS, nolls, dtype=torch.float64))
    more = len(nolls) - len(NOLLS)
    sigma_nm = torch.full((len(nolls),), 50.0, dtype=torch.float64) if more else None
    problem = ImageFit(model, Layout(nolls, prior_sigma_nm=sigma_nm), data, data + 9.0)
    start = torch.cat([PLACE[:, :-2], torch.zeros(1, more, dtype=torch.float64), PLACE[:, -2:]], dim=1)
    x = solve(problem, start).values
    causes = causes_of_misfit(problem, x, Asked(CONDITIONS, 1.0, cutoff), facts_only=facts_only)
    return causes, float(problem.reduced_chi2(x)[0])


@pytest.mark.parametrize("factor", [0.96, 1.02])
def test_the_scale_of_the_pixels_is_named_first_within_its_error(factor):
    causes, chi2_nu = found(replace(SETTINGS, pixel_scale_mas=SETTINGS.pixel_scale_mas * factor))
    first = causes[0]
    assert chi2_nu > 2 and first.name == "plate_scale" and first.explains > 0.95
    assert first.declared == SETTINGS.pixel_scale_mas and first.unit == "mas"
    assert abs(first.value - SETTINGS.pixel_scale_mas * factor) < 4 * first.sigma
    assert first.sigma < 0.002 * first.declared and first.key in first.says


def test_many_modes_that_imitate_a_wrong_scale_do_not_hide_it():
    changed = replace(SETTINGS, pixel_scale_mas=SETTINGS.pixel_scale_mas * 0.98)
    first = found(changed, nolls=tuple(range(2, 92)))[0][0]
    assert first.name == "plate_scale" and first.value == pytest.approx(changed.pixel_scale_mas, rel=0.003)


def test_a_turned_pupil_and_a_glow_are_told_apart():
    causes, _ = found(replace(SETTINGS, geometry=turned(SETTINGS.geometry, 20.0)))
    assert causes[0].name == "pupil_rotation" and causes[0].value == pytest.approx(20.0, abs=1.0)
    glow = torch.linspace(0, 200, WINDOW, dtype=torch.float64).expand(WINDOW, WINDOW)
    causes, _ = found(SETTINGS, glow)
    assert causes[0].name == "background" and causes[0].value == pytest.approx(200.0, rel=0.1)
    assert all(one.explains < 0.5 for one in found(SETTINGS, glow, facts_only=True)[0])


def test_pixels_too_large_for_the_field_are_no_cause():
    y, x = np.indices((WINDOW, WINDOW)) - (WINDOW - 1) / 2
    disc = torch.as_tensor(5 * FLUX_E * np.exp(-(x**2 + y**2) / 162) / (162 * np.pi))
    causes, chi2_nu = found(SETTINGS, disc, cutoff=4.9)
    assert chi2_nu > 2 and causes
    assert all(np.isfinite(one.explains) and 0 < one.explains <= 1 for one in causes)


@pytest.mark.parametrize(
    ("modes_nm", "value", "unit"),
    [
        ({5: -150.0, 6: 160.0}, 5.0, "Noll"),  # the fit moves what was declared in Noll 5 to Noll 6
        ({5: 160.0, 6: -160.0}, 6.0, "Noll"),
        ({6: 340.0}, 160.0, "nm"),
    ],
)
def test_the_diversity_in_the_light_is_that_which_makes_the_modes_likely(modes_nm, value, unit):
    declared = {5: -160.0} if unit == "Noll" and value == 6.0 else {6: -160.0}
    known = replace(SETTINGS.known, diversity_nm=declared)
    conditions = replace(CONDITIONS, settings=replace(SETTINGS, known=known))
    (cause,) = improbable_diversity(dict.fromkeys(range(2, 12), 5.0) | modes_nm, conditions)
    assert (cause.value, cause.unit) == (value, unit)
    assert improbable_diversity(dict.fromkeys(range(2, 12), 30.0), conditions) == []
