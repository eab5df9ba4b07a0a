"""Effects in a recipe. Truth: the catalogue of names and units that recipes are written by."""

import numpy as np
import pytest
from helpers.effect_cases import STRONG
from helpers.recordings import recording as made

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.stages.base import EffectEntry, ModelConfig
from irlos_pipe.stages.model.effects import (
    calibrated_effects,
    model_effects,
)

IRLOS = load_instrument("irlos")


def recording(diversity):
    return made(np.zeros((1, 64, 64)), diversity=diversity)


def effects_of(*entries, diversity=None):
    return model_effects(IRLOS, ModelConfig(effects=entries), recording(diversity or {6: -170.0}))


@pytest.mark.parametrize("name", sorted(set(STRONG) - {"bad_pixels", "ao_cutoff"}))
def test_every_effect_can_be_free_fixed_or_free_from_a_start(name):
    (free,) = effects_of(name)
    (fixed,) = effects_of({name: STRONG[name]})
    (started,) = effects_of({name: STRONG[name] | {"fit": True}})
    assert len(free.parameters) > 0
    assert fixed.parameters == ()
    assert [p.start for p in started.parameters] == pytest.approx(fixed.values)
    assert len(started.parameters) == len(fixed.values)


@pytest.mark.parametrize(("entry", "message"), [
    ("companoin", "did you mean 'companion'"),
    ({"companion": {"flux_ratio": 0.1}}, r"companion is fixed by \{flux_ratio, sep_mas, pa_deg\}"),
    ({"tip_tilt_jitter": {"sigma_mas": -1}}, "tip_tilt_jitter.sigma_mas must lie between 0 and 60"),
    ({"high_order_ncpa": {"zernike_nm": [1, 2]}}, "must be a table {Noll index: value}"),
    ({"low_wind_effect": {"piston_nm": [1], "tip_nm": [0] * 4, "tilt_nm": [0] * 4}}, "lists of 1 and 4"),
    ({"bad_pixels": {"pixels": [3, 4]}}, r"must be a list of \[row, column\]"),
    ({"vibration": {"speed": 3}}, r"options: \{shape\}"),
    ({"vibration": {"shape": "square"}}, "vibration.shape must be sinusoidal or gaussian, not 'square'"),
])  # fmt: skip
def test_a_wrong_entry_is_refused_with_what_is_allowed(entry, message):
    with pytest.raises(ValueError, match=message):
        EffectEntry.of(entry)
    with pytest.raises(ValueError, match="listed twice: vibration"):
        ModelConfig(effects=("vibration", "companion", "vibration", "companion"))


@pytest.mark.parametrize(("entry", "diversity", "message"), [
    ("diversity_error", {6: 0.0}, "diversity_error for cube: there is no diversity"),
    ("ao_cutoff", None, "outside the window"),
    ("bad_pixels", {6: 1.0}, "bad_pixels for cube: there is nothing to estimate"),
    ({"bad_pixels": {"pixels": [[64, 0]]}}, {6: 1.0}, "outside the window"),
    ({"seeing_halo": {"wfe_nm": 100, "scale": 1}}, {6: 1.0}, "either wfe_nm or scale"),
])  # fmt: skip
def test_an_effect_that_means_nothing_for_a_recording_is_an_error_of_the_recipe(entry, diversity, message):
    with pytest.raises(ConfigurationError, match=message):
        effects_of(entry, diversity=diversity)


def _arrays(effect_values):
    return {f"effects/{name}": Quantity(np.array(values), "", "") for name, values in effect_values.items()}


def test_what_two_companions_were_calibrated_to_is_handed_on_to_the_same_two():
    second = STRONG["companion"] | {"sep_mas": 150.0}
    entries = ("companion", {"companion": second | {"fit": True}}, {"tip_tilt_jitter": {"sigma_mas": 8.0}})
    model, cube = ModelConfig(effects=entries), recording({6: -170.0})
    found = {"companion": [0.03, 90.0, -20.0], "companion_2": [0.01, -60.0, 120.0]}
    product = Product("calibrate", _arrays(found), {"effects": {}})
    known = calibrated_effects(product, IRLOS, model, cube, 0.8, same_star=True)
    assert {label: effect.values.tolist() for label, effect in known.items()} == found | {
        "tip_tilt_jitter": [64.0]
    }
    assert set(calibrated_effects(product, IRLOS, model, cube, 0.8)) == {"tip_tilt_jitter"}


def test_a_calibration_with_other_parameters_than_the_present_effect_has_is_refused():
    model, cube = ModelConfig(effects=("seeing_halo",)), recording({6: -170.0})
    fewer = {"seeing_halo": np.array([8000.0, 2.0, 0.0, 0.0, 0.0, 0.0])}
    product = Product("calibrate", _arrays(fewer), {"effects": {}})
    with pytest.raises(InputDataError, match=r"seeing_halo has 6 parameters.*calibrate again"):
        calibrated_effects(product, IRLOS, model, cube, 0.8)
