"""A correction that ends elsewhere than told.

Truth: quadrature of the definition by SciPy, finite differences, and recordings of the simulator, which
shares no optics with the model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
import torch
from helpers.optics_cases import (
    BAND,
    DIVERSITY,
    FACILITY,
    NCPA_LAW,
    PRIOR,
    draw_frames,
    everything,
    settings,
)
from helpers.simulated_scenes import FINE, NARROW_H, NCPA_NM, UT4, scene

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Conditions, SeeingHalo
from irlos_pipe.effects.seeing_halo import AoCutoff
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand, seeing_to_r0_m, von_karman_nm2
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose

LOW = ResidualBand(BAND.low_per_m, 0.5, BAND.outer_scale_m)
SEEING_ARCSEC = 0.6
LAW = ResidualLaw(225.0, 40.0)  # 175 nm at 0.6 arcsec, nearly all of it beyond so low a cut-off
EFFECT = AoCutoff(LOW, LAW, SEEING_ARCSEC)
WINDOW, FRAMES, HIGHEST_NOLL, TRUE_PER_M = (48, 48), 60, 30, 0.6
NOISE = NoiseModel(1.0, 1.0)


def grid():
    grids = PsfModel(settings(WINDOW, pupil_samples=64), (2, 3, 4), dtype=torch.float64).grids
    return OtfGrid.of(grids.focal, grids.sampling)


def turbulence_nm2(f_per_m: float) -> float:
    return float(von_karman_nm2(np.array(f_per_m), seeing_to_r0_m(SEEING_ARCSEC), LOW.outer_scale_m))


def factor(per_m: float) -> torch.Tensor:
    on = grid()
    one = torch.ones(1, *on.focal.baseline_y_m.shape, len(on.focal.baseline_x_m), dtype=torch.float64)
    return EFFECT.apply(torch.tensor([per_m]).double(), one, on)


@pytest.mark.parametrize("per_m", [0.4, 0.7])
def test_the_factor_is_that_of_the_structure_function_between_the_cut_offs(per_m):
    """Adaptive quadrature of 2 (1 - J0) over the rings between: turbulence, less what is left inside."""
    on, (row, column) = grid(), (3, 4)
    length = float(np.hypot(on.focal.baseline_x_m[column], on.focal.baseline_y_m[row]))
    in_band = (0.3 * LAW.wfe_nm(SEEING_ARCSEC)) ** 2 / (2 * np.pi * np.log(0.5 / LOW.low_per_m))

    def ring(f: float) -> float:
        power = turbulence_nm2(f) - in_band / f**2
        return float(4 * np.pi * f * power * (1 - scipy.special.j0(2 * np.pi * f * length)))

    structure_nm2 = scipy.integrate.quad(ring, per_m, 0.5)[0]
    expected = np.exp(-0.5 * (2 * np.pi / 1600.0) ** 2 * structure_nm2)
    assert float(factor(per_m)[0, row, column]) == pytest.approx(expected, rel=1e-4)


def test_its_derivative_is_a_finite_difference():
    values, step = torch.tensor([0.57]).double(), 1e-5
    on = grid()
    start = torch.rand(1, *factor(0.5).shape[1:], dtype=torch.float64)
    (slope,) = EFFECT.slopes(values, start, on, [0])
    high, low = (EFFECT.apply(values + sign * step, start, on) for sign in (1, -1))
    assert slope.numpy() == pytest.approx(
        ((high - low) / (2 * step)).numpy(), abs=1e-7 * float(slope.abs().max())
    )


# -- recordings ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded() -> tuple[Frames, Conditions]:
    """Frames behind an AO that ends at 0.6 cycles per metre, and what is told of them: 0.5."""
    ncpa_nm = {noll: value for noll, value in NCPA_NM.items() if noll <= HIGHEST_NOLL}
    made = scene(
        window=WINDOW,
        frames=FRAMES,
        seed=(11, 3),
        ncpa_nm=ncpa_nm,
        throughput=0.05,
        sky=Sky(SEEING_ARCSEC),
        sampling=replace(FINE, step_s=0.02),
        facility=replace(FACILITY, cutoff_per_m=TRUE_PER_M, residual_law=LAW),
    )
    exposed = expose(made)
    images = torch.as_tensor(
        np.stack([draw_frames(mean, 1, seed, NOISE)[0] for seed, mean in enumerate(exposed.mean_e)])
    )
    spectrum = tuple((band.centre_nm, 1.0) for band in NARROW_H)
    told = PsfSettings(UT4, WINDOW, 9.7, spectrum, KnownWavefront(DIVERSITY))
    conditions = Conditions(told, LOW, LAW, SEEING_ARCSEC, HIGHEST_NOLL, ncpa_law=NCPA_LAW)
    return Frames(images, everything(images), NOISE), conditions


@pytest.mark.slow
def test_the_cut_off_of_a_recording_is_found_to_a_fifth_of_what_was_told_wrong(recorded):
    """As the residual inside is not quite as expected, the quoted error alone does not do."""
    frames, conditions = recorded
    effects = [SeeingHalo.under(conditions), AoCutoff.under(conditions)]
    options = CalibrationOptions("long_exposure", highest_noll=HIGHEST_NOLL, prior=PRIOR)
    found = calibrate(frames, conditions.settings, options, effects)
    assert found.effects["ao_cutoff"]["per_m"] == pytest.approx(TRUE_PER_M, abs=0.02)
    assert found.effects_sigma["ao_cutoff"]["per_m"] < 0.02


@pytest.mark.long
def test_a_cut_off_told_wrong_is_named_with_the_value_that_the_data_want(recorded):
    frames, conditions = recorded
    options = Options(HIGHEST_NOLL, held_out=0.25, most_names=1, sure=5.0)
    diagnosis = diagnose([Exposures(frames, conditions)], [SeeingHalo.under(conditions)], options)
    step = diagnosis.steps[0]
    assert step.name == "ao_cutoff"
    assert step.public["per_m"] == pytest.approx(TRUE_PER_M, abs=0.04)
