"""Calibrations with effects that a diagnosis found. Truth: the image that the same numbers make, which is to
stay on the way from one problem to the other; made-up objectives."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects import FixedEffect, TipTiltJitter
from irlos_pipe.effects.colour import PlateScale
from irlos_pipe.effects.companion import Companion
from irlos_pipe.estimate import calibration
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.cube_fit import CubeFit
from irlos_pipe.estimate.effect_modes import starts_as_told
from irlos_pipe.estimate.open_fit import open_basis
from irlos_pipe.estimate.open_minima import _Search, likelier_minimum
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 12))
PLACE = [0.01, 90.0, -70.0]  # flux ratio, x and y [mas]
NAMES = [parameter.name for parameter in Companion().parameters]


@pytest.fixture(scope="module")
def task() -> CubeFit:
    psf = PsfModel(cases.settings(), NOLLS, dtype=torch.float64)
    modes_nm = cases.vector(cases.ncpa_nm(4, highest_noll=11, total_nm=60.0), NOLLS)
    images = cases.draw_frames(psf.images(modes_nm)[0].double().numpy() * 3e6, 4, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    return CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR), None, None)


def test_only_what_was_found_before_starts_as_told():
    companion = Companion()
    assert starts_as_told(FixedEffect(companion, PLACE, NAMES))
    assert not starts_as_told(FixedEffect(companion, PLACE))  # held
    assert not starts_as_told(companion)
    assert not starts_as_told(FixedEffect(PlateScale(9.7), [0.0], ["fraction"]))  # free, but from nothing
    assert starts_as_told(FixedEffect(PlateScale(9.7), [0.004], ["fraction"]))
    assert not starts_as_told(FixedEffect(TipTiltJitter(), [8.0], ["sigma_mas"]))  # in every recording


def test_releasing_an_effect_changes_no_image(task):
    told, jitter = FixedEffect(Companion(), PLACE, NAMES), TipTiltJitter()
    held = task.fit([told.expected(), jitter])
    problem, values = task.released([told, jitter], held)
    assert problem.layout.size == held[0].layout.size + len(NAMES)
    before, after = held[0].predict(held[1].values), problem.predict(values)
    assert torch.allclose(after, before, rtol=1e-12, atol=1e-9)
    assert np.allclose(
        problem.model.effects.split(values[0, problem.layout.effect_values])["companion"], PLACE
    )


def test_other_minima_begin_with_effects_that_the_closed_basis_held_where_they_were_told(monkeypatch, task):
    told = FixedEffect(Companion(), PLACE, NAMES)
    held = task.fit([told.expected()])
    problem, values = task.released([told], held)
    opened = open_basis(problem, values, max_iterations=1)
    begun: list[torch.Tensor] = []
    monkeypatch.setattr(_Search, "best_from", lambda search, starts, known: begun.extend(starts))
    assert likelier_minimum(task, held, opened, most=0.0) is opened
    layout = opened.problem.layout
    assert [one.shape for one in begun] == [(1, layout.size)] * 2
    assert np.allclose([one[0, layout.effect_values].numpy() for one in begun], [PLACE] * 2)


@pytest.mark.parametrize(("other", "told_wins"), [(90.0, True), (110.0, False), (None, False)])
def test_the_likelier_of_both_ways_is_kept(monkeypatch, task, other, told_wins):
    told = FixedEffect(Companion(), PLACE, NAMES)
    closed = task.fit([told])

    def ended(objective):
        return SimpleNamespace(solution=SimpleNamespace(objective=torch.tensor([objective])))

    opened, begun = ended(100.0), other and ended(other)
    monkeypatch.setattr(calibration, "open_basis", lambda problem, values, max_iterations: begun)
    fit, found = calibration._from_told(task, closed, opened)
    assert found is (begun if told_wins else opened)
    assert (fit is closed) is not told_wins
    assert len(fit[0].model.effects.parameters) == (0 if told_wins else len(NAMES))
