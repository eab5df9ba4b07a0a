"""Facts that a diagnosis leaves free. Truth: what was put into frames drawn from the model (same code)."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.diagnose_frames import CONDITIONS, cube, fitted, image

from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.open_facts import open_facts
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.stages.diagnose.output import model_entries

STOP = CATALOGUE["pupil_misregistration"].under(CONDITIONS)
TRUE = (0.06, -0.6, 1.0)


@pytest.fixture(scope="module")
def behind_a_stop():
    """Frames behind a stop that is off, and a fit that takes all facts for exact."""
    training = cube(image(effect=STOP, values=TRUE)).training
    model = fitted(training, [])
    return Fitter(model.views, training), Optimum(training, model)


@pytest.fixture(scope="module")
def found(behind_a_stop) -> dict[str, FixedEffect]:
    return {effect.name: effect for effect in open_facts(*behind_a_stop, [])}


def test_facts_that_the_model_takes_for_exact_are_left_free_where_they_fit_best(found):
    true, stop = STOP.describe(np.array(TRUE)), found[STOP.name]
    values = stop.base.describe(stop.values)
    assert values["dx_m"] == pytest.approx(true["dx_m"], abs=0.01)
    assert values["dy_m"] == pytest.approx(true["dy_m"], abs=0.01)
    assert values["rotation_deg"] == pytest.approx(true["rotation_deg"], abs=0.5)
    assert "plate_scale" not in found  # which is as told


def test_the_model_of_a_recipe_has_them_free_from_there():
    result = SimpleNamespace(steps=[], adjusted=[], open_facts=[FixedEffect(STOP, TRUE)])
    (entry,) = model_entries(result)
    assert entry[STOP.name]["fit"] is True
    assert entry[STOP.name]["rotation_deg"] == pytest.approx(1.0)
