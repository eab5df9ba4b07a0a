"""Which recordings have dispersion and the star's colour in their model."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.effect_cases import CONDITIONS

from irlos_pipe.effects import SeeingHalo, TipTiltJitter
from irlos_pipe.effects.declaration import Refraction
from irlos_pipe.stages.model.effects import with_colour
from irlos_pipe.stages.model.section import ModelConfig

SKY = [SeeingHalo.under(CONDITIONS), TipTiltJitter()]
NARROW = replace(CONDITIONS, settings=replace(CONDITIONS.settings, spectrum=((1585.0, 1.0), (1615.0, 1.0))))
DEFAULT = ModelConfig()


def names(effects):
    return [effect.name for effect in effects]


def test_a_broad_band_on_sky_has_dispersion_as_expected_and_a_free_colour():
    known = replace(CONDITIONS, refraction=Refraction((120.0, -30.0), 17.0))
    *usual, dispersion, colour = with_colour(SKY, DEFAULT, known)
    assert names(usual) == names(SKY)
    assert [p.start for p in dispersion.parameters] == [120.0, -30.0]
    assert [p.prior_sigma for p in dispersion.parameters] == [17.0, 17.0]
    assert (colour.name, [p.name for p in colour.parameters]) == ("spectrum", ["slope_per_um"])


@pytest.mark.parametrize(
    ("effects", "model", "conditions"),
    [(SKY, DEFAULT, NARROW), (SKY[1:], DEFAULT, CONDITIONS), (SKY, ModelConfig(colour="listed"), CONDITIONS)],
    ids=["a narrow band", "the bench", "switched off"],
)
def test_others_have_neither(effects, model, conditions):
    assert names(with_colour(effects, model, conditions)) == names(effects)
