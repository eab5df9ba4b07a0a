"""On a GPU everything comes out as on the CPU. Truth: the same calculation on the CPU.

Where there is none, the stand-in of `stand_in_device` shows that no operation mixes tensors of both, and
counts that the propagation was asked of the device; the tests on a real one are skipped.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import invoke
from helpers import optics_cases as cases
from helpers.effect_cases import NOLLS, SPECTRUM, STRONG, WINDOW, made
from helpers.stand_in_device import StandInDevice

from irlos_pipe.diagnosis.checks.drift import measure_drift
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.held_out import HeldOutEvaluation
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.search.scores import companion_gains, families, scores
from irlos_pipe.diagnosis.splitting import HeldOutFrames
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.effects import Conditions, TipTiltJitter
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.elongation import calibrate_law
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.optics.psf import PsfModel

SMALL, HIGHEST_NOLL, TTF = cases.settings(16, pupil_samples=48), 7, (2, 3, 4)
TRUE_NM = cases.ncpa_nm(4, HIGHEST_NOLL, 60.0)
CONDITIONS = Conditions(SMALL, cases.BAND, cases.RESIDUAL_LAW, 0.5, HIGHEST_NOLL)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no CUDA device")


def cube() -> Frames:
    """Frames with a few modes of aberration."""
    nolls = tuple(TRUE_NM)
    image = PsfModel(SMALL, nolls).images(cases.vector(TRUE_NM, nolls)).double().numpy() * 1e6
    images = cases.draw_frames(image, 16, seed=5)
    return Frames(images, cases.everything(images), cases.READ_NOISE)


def calibrated(method: str, device: str) -> np.ndarray:
    """NCPAs and, where the method has effects, the jitter."""
    effects = [TipTiltJitter()] if method == "long_exposure" else []
    options = CalibrationOptions(method, highest_noll=HIGHEST_NOLL, max_iterations=8, prior=cases.PRIOR)
    result = calibrate(cube(), SMALL, options, effects, device=device)
    return np.concatenate([result.zernike_nm, result.sigma_nm, *result.effect_values.values()])


def calibrated_beside_a_companion(device: str) -> np.ndarray:
    """NCPAs beside an effect whose place is searched for."""
    options = CalibrationOptions(highest_noll=HIGHEST_NOLL, max_iterations=3, prior=cases.PRIOR)
    return calibrate(cube(), SMALL, options, [made("companion")[0]], device=device).zernike_nm


def estimated_by_lift(device: str) -> np.ndarray:
    """Tip, tilt and defocus of a ramp, the size of the star fitted along."""
    model = PsfModel(SMALL, TTF, device=device)
    introduced_nm = np.array([-150.0, 0.0, 150.0, 80.0])
    true = torch.zeros(4, 3, dtype=torch.float64)
    true[:, 2] = torch.as_tensor(introduced_nm)
    images = cases.draw_frames(PsfModel(SMALL, TTF).images(true).double().numpy() * 1e5, 4, seed=2)
    data = RampData(images, cases.everything(images), cases.READ_NOISE, introduced_nm)
    start = scan_start_nm(model, images, data.good)
    fit = fit_ramp(model, data, start, LiftOptions(max_iterations=8), [TipTiltJitter()])
    return np.concatenate([fit.result.zernike_nm.numpy().ravel(), fit.result.sigma_nm.numpy().ravel()])


def bounded(device: str) -> np.ndarray:
    """Smallest standard errors of tip, tilt and defocus."""
    model = ImageModel(PsfModel(SMALL, TTF, device=device))
    modes_nm, flux_e = torch.zeros(2, 3, dtype=torch.float64), torch.tensor([1e4, 1e5])
    return cramer_rao_nm(model, modes_nm, flux_e, cases.READ_NOISE).numpy().ravel()


def diagnosed(device: str) -> np.ndarray:
    """A fit of the mean image, what two families, companions and a drift would add, and the gap held out."""
    parts, view = (
        HeldOutFrames().split(cube()),
        Exposures(cube(), CONDITIONS).view(range(2, HIGHEST_NOLL + 1), device),
    )
    fitted = Fitter([view], parts.training).fit([TipTiltJitter()])
    optimum = Optimum(parts.training, fitted)
    some = [
        one for one in families(CONDITIONS, [])[0] if one.effect.name in ("plate_scale", "diversity_error")
    ]
    gains = [score.gain for score in scores(optimum, some)]
    drift = measure_drift(parts.training, fitted, sure=5.0)
    companions = companion_gains(optimum).max()
    gap = HeldOutEvaluation(parts.held_out, fitted).gap
    return np.array([*fitted.modes_nm, *gains, companions, *drift.change_nm, gap])


def law(device: str) -> np.ndarray:
    """Defocus from the elongation."""
    found = calibrate_law(PsfModel(SMALL, [4], device=device))
    return np.array([found.A, found.B])


def with_effect(name: str, device: str) -> np.ndarray:
    """Images and all derivatives with one effect."""
    effect, values = made(name)
    model = PsfModel(cases.settings(WINDOW, SPECTRUM, pupil_samples=64), NOLLS, device=device)
    modes, ones = cases.vector(cases.ncpa_nm(6, NOLLS[-1], 100.0), NOLLS), torch.ones(1, dtype=torch.float64)
    image, columns = ImageModel(model, [effect]).predict_and_jacobian(modes, 1e5 * ones, ones, values)
    return np.concatenate([image.cpu().numpy().ravel(), columns.double().cpu().numpy().ravel()])


CALCULATIONS = {
    "long_exposure": lambda device: calibrated("long_exposure", device),
    "dip_global": lambda device: calibrated("dip_global", device),
    "dip_joint": lambda device: calibrated("dip_joint", device),
    "search": calibrated_beside_a_companion,
    "lift": estimated_by_lift,
    "bound": bounded,
    "diagnose": diagnosed,
    "prior": law,
    **{name: lambda device, name=name: with_effect(name, device) for name in STRONG},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALCULATIONS)
def test_no_operation_mixes_tensors_of_two_devices(name):
    expected = CALCULATIONS[name]("cpu")
    with StandInDevice() as device:
        found = CALCULATIONS[name]("cuda")
    assert device.operations > 20
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@needs_gpu
@pytest.mark.parametrize("name", CALCULATIONS)
def test_a_gpu_gives_the_results_of_the_cpu(name):
    """Within the rounding of float32 products, of which fits make a hundredth of their errors."""
    expected = CALCULATIONS[name]("cpu")
    assert CALCULATIONS[name]("cuda") == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(expected).max())


@pytest.mark.slow
def test_no_stage_mixes_tensors_of_two_devices(monkeypatch, tmp_path):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    told = ["run", "diagnose_ramp", "--samples", "--output", str(tmp_path), "--device", "cuda", "--jobs", "1"]
    with StandInDevice() as device:
        result = invoke(*told)
    assert result.exit_code == 0, result.stderr
    assert device.operations > 10_000


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_an_error_of_one_line_and_of_usage(tmp_path):
    result = invoke("run", "ncpa_calibration", "--samples", "--output", tmp_path, "--device", "cuda")
    assert result.exit_code == 2
    assert "PyTorch finds no CUDA device" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
