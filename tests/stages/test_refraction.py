"""Atmospheric dispersion from altitude and air. Truth: Filippenko's formula, written out here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import Acquisition, Detector
from irlos_pipe.readers.acquisition import altitude_deg
from irlos_pipe.stages.model.effects import refraction_mas, refraction_of

J_H = ((1215.0, 0.5), (1625.0, 0.5))
AIR = {"pressure_hpa": 743.0, "temperature_c": 11.5, "humidity_percent": 15.0}
UP = Acquisition("psf", Detector(1, 1), J_H, {}, 9.7, altitude_deg=45.0, zenith_angle_deg=60.0, **AIR)


def edlen(um: float, pressure_hpa: float, temperature_c: float) -> float:
    """n − 1 of dry air: Edlén 1953 as Filippenko 1982 has it."""
    s = um**-2
    standard = 1e-6 * (64.328 + 29498.1 / (146 - s) + 255.4 / (41 - s))
    p = pressure_hpa / 1.333224
    return (
        standard
        * p
        * (1 + (1.049 - 0.0157 * temperature_c) * 1e-6 * p)
        / 720.883
        / (1 + 0.003661 * temperature_c)
    )


@pytest.mark.parametrize("altitude", [80.0, 60.0, 45.0, 30.0])
def test_j_and_h_lie_as_far_apart_as_by_filippenko_s_formula(altitude):
    j, h = (refraction_mas(altitude, *AIR.values(), um) for um in (1.215, 1.625))
    change = edlen(1.215, 743.0, 11.5) - edlen(1.625, 743.0, 11.5)
    expected = change * np.tan(np.deg2rad(90 - altitude)) * np.rad2deg(1) * 3.6e6
    assert j - h == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize("unknown", ["altitude_deg", "zenith_angle_deg", "pressure_hpa"])
def test_what_is_not_known_leaves_dispersion_to_the_data(unknown):
    expected = refraction_of(replace(UP, **{unknown: None}), 1.42)
    assert expected.mas_per_um == (0.0, 0.0)
    assert expected.sigma_mas_per_um >= 300


def test_airmass_stands_in_for_the_altitude_and_must_not_contradict_it():
    assert altitude_deg(None, 2.0, "here") == pytest.approx(30.0)
    assert altitude_deg(30.0, 1.99, "here") == 30.0
    with pytest.raises(
        InputDataError, match=r"^here altitude_deg = 60 means an airmass of 1.15, but airmass = 2;"
    ):
        altitude_deg(60.0, 2.0, "here")
