"""Simulated images of pupils of other shapes against the model that is fitted to them (independent code)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.optics_cases import settings, vector
from helpers.simulated_scenes import NCPA_NM, image

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, placed
from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Circle, Hexagons, Placement, Polygon, Samples
from irlos_pipe.effects import CATALOGUE, EffectSet, FixedEffect
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres
from irlos_pipe.optics.structure_function import ResidualBand

SIX_VANES = tuple(
    Vane((0.0, 0.0), (4.2 * np.cos(a), 4.2 * np.sin(a)), 0.03) for a in np.deg2rad(np.arange(0, 360, 60))
)
SEGMENTED = PupilGeometry(8.0, 1.8, SIX_VANES, (Hexagons(1.1, 0.02, 3, (0, 22)),))
TRIANGLE = Polygon(((-2.5, -2.0), (3.0, -1.5), (0.5, 3.2)))
SHIFTED = placed(
    PupilGeometry(8.0, 1.0, SIX_VANES[:3], (TRIANGLE,), (Circle(0.5).placed(Placement(shift_m=(1.0, 0.2))),)),
    Placement.of(30.0, "y", (0.2, -0.1)),
)
U = grid_centres(200, 0.041)
MAP = PupilGeometry(
    8.2, aperture=(AmplitudeMap(Samples.of(area_weighted_pupil(replace(SHIFTED, diameter_m=8.2), U)), 0.041),)
)


def modelled(geometry: PupilGeometry, effect: str = "", pixel_scale_mas=9.7, **public) -> np.ndarray:
    nolls = tuple(NCPA_NM)
    case = settings(48, geometry=geometry, pixel_scale_mas=pixel_scale_mas).for_broad_images()
    model = PsfModel(case, nolls, dtype=torch.float64)
    effects = []
    if effect:
        kind = CATALOGUE[effect]
        conditions = Conditions(model.settings, ResidualBand(1 / 8, 2.5, 25.0), None, 0.5, nolls[-1])
        made = kind.under(conditions, **kind.options_for(**public))
        effects = [FixedEffect(made, made.values_of(**public))]
    optics = EffectSet(effects, model.grids)()
    return model.images(vector(NCPA_NM, nolls), optics)[0].numpy()


@pytest.mark.slow
@pytest.mark.parametrize(
    "geometry",
    [
        pytest.param(SEGMENTED, id="segmented", marks=pytest.mark.long),
        pytest.param(SHIFTED, id="polygon"),
        pytest.param(MAP, id="map", marks=pytest.mark.long),
    ],
)
def test_simulated_images_are_those_of_the_model(geometry):
    truth = modelled(geometry)
    assert np.abs(image(geometry=geometry) - truth).max() < 1e-4 * truth.max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "public"),
    [
        pytest.param(
            "low_wind_effect",
            {k: [30.0, -50.0, 80.0, -20.0, 10.0, -60.0] for k in ("piston_nm", "tip_nm")},
            id="petals",
        ),
        pytest.param(
            "segment_piston",
            {"piston_nm": np.random.default_rng(1).normal(0, 80, 35).tolist()},
            id="segments",
        ),
        pytest.param(
            "pupil_misregistration",
            {"dx_m": 0.11, "dy_m": -0.07, "rotation_deg": 7.0},
            id="stop",
            marks=pytest.mark.long,
        ),
    ],
)
def test_effects_of_pupil_parts_are_those_of_the_model(effect, public):
    if effect == "low_wind_effect":
        public = {**public, "tilt_nm": [0.0] * 6}
    truth = modelled(SEGMENTED, effect, **public)
    found = image(geometry=SEGMENTED, effects={effect: public})
    assert np.abs(found - truth).max() < 2e-4 * truth.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pharo", pytest.param("nirc2_narrow", marks=pytest.mark.long), "bench"])
def test_the_pupils_of_profiles_are_simulated_as_they_are_modelled(name):
    instrument = load_instrument(name)
    scale = {"pixel_scale_mas": instrument.defaults["pixel_scale_mas"]}
    truth = modelled(instrument.pupil, **scale)
    assert np.abs(image(geometry=instrument.pupil, **scale) - truth).max() < 1e-4 * truth.max()
