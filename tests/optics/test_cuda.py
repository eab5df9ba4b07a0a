"""On a GPU everything comes out as on the CPU. Truth: the same calculation on the CPU.

Where there is none, the stand-in of `stand_in_device` shows that no operation mixes tensors of both, and
counts that the propagation was asked of the device; the tests on a real one are skipped.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch
from conftest import invoke, without_report
from helpers import optics_cases as cases
from helpers.effect_cases import NOLLS, SPECTRUM, STRONG, WINDOW, made
from torch.overrides import TorchFunctionMode
from torch.utils.weak import WeakIdKeyDictionary

from irlos_pipe.diagnosis.acceptance import HeldOutEvaluation
from irlos_pipe.diagnosis.checks import measure_drift
from irlos_pipe.diagnosis.cube import without_blocks_of_time
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.scores import families, scores
from irlos_pipe.diagnosis.view import Exposures, Moment, Moments
from irlos_pipe.effects import Conditions, TipTiltJitter
from irlos_pipe.effects.colour import PlateScale
from irlos_pipe.effects.companion import Ghost
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions, LiftOptions
from irlos_pipe.estimate.causes import Asked, causes_of_misfit
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.elongation import calibrate_law
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.estimate.score_test import copy_gains
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.numerics import parallel
from irlos_pipe.optics.psf import PsfModel

DEVICE = "cuda"
TO_NUMPY = (torch.Tensor.numpy, torch.Tensor.__array__)
ITEMS = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)
INTO_FIRST = (*ITEMS, torch.Tensor.copy_)


class MixedDevicesError(RuntimeError):
    """Tensors of two devices in one operation."""


class StandInDevice(TorchFunctionMode):
    """While it is active, ``cuda`` exists; `operations` counts what was computed on it."""

    def __init__(self):
        super().__init__()
        self.there, self.operations = WeakIdKeyDictionary(), 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function == torch.Tensor.device.__get__:
            return torch.device(DEVICE if args[0] in self.there else "cpu")
        if function in TO_NUMPY and args[0] in self.there:
            raise TypeError(f"can't convert a tensor on {DEVICE} to numpy; use Tensor.cpu() first")
        if function is torch.autograd.grad:
            return self._gradients(*args, **kwargs)
        target = self._target(function, args, kwargs)
        if target is None and self._mixes(function, args, kwargs):
            raise MixedDevicesError(f"{function.__name__} of tensors on {DEVICE} and on the CPU")
        stays = target == DEVICE or (target is None and self._follows(function, args, kwargs))
        result = function(*_without_device(args), **{k: v for k, v in kwargs.items() if k != "device"})
        if target is not None and args and result is args[0] and stays != (result in self.there):
            result = result.clone()  # moved, and so another tensor
        if stays:
            self.operations += 1
            _remember(self.there, tensors(result))
        return result

    def _gradients(self, outputs, inputs, **options):
        """Derivatives are where the inputs are, wherever the outputs are."""
        found = torch.autograd.grad(outputs, inputs, **options)
        _remember(self.there, [one for one, own in zip(found, inputs, strict=True) if own in self.there])
        return found

    def _target(self, function, args, kwargs) -> str | None:
        if function is torch.Tensor.cpu:
            return "cpu"
        if function is torch.Tensor.to and isinstance(args[1], torch.Tensor):
            return DEVICE if args[1] in self.there else "cpu"
        named = [a for a in (*args, kwargs.get("device")) if _is_device(a)]
        return str(named[0]) if named else None

    def _mixes(self, function, args, kwargs) -> bool:
        if function is torch.Tensor.copy_:
            return False
        if function in ITEMS:
            return self._mixes_items(*args)
        return len({tensor in self.there for tensor in tensors((args, kwargs)) if tensor.ndim}) > 1

    def _mixes_items(self, tensor, index, value=None) -> bool:
        """Indices may be on the CPU; what is put in place of a slice may come from anywhere."""
        indices = [one for one in tensors(index) if one.ndim]
        put = [one for one in tensors(value) if one.ndim] if indices else []
        here = tensor in self.there
        foreign_index = any(one in self.there and not here for one in indices)
        return foreign_index or any((one in self.there) != here for one in put)

    def _follows(self, function, args, kwargs) -> bool:
        """Whether what is computed from these is on the device."""
        sources = args[:1] if function in INTO_FIRST else (args, kwargs)
        return any(tensor in self.there for tensor in tensors(sources))


def _remember(there, found) -> None:
    for tensor in found:
        there[tensor] = True


def _is_device(argument) -> bool:
    return isinstance(argument, (str, torch.device)) and str(argument) in (DEVICE, "cpu")


def _without_device(args: tuple) -> tuple:
    return tuple(argument for argument in args if not _is_device(argument))


def tensors(nested) -> Iterator[torch.Tensor]:
    if isinstance(nested, torch.Tensor):
        return iter([nested])
    if isinstance(nested, dict):
        nested = list(nested.values())
    if isinstance(nested, (tuple, list)):
        return chain.from_iterable(map(tensors, nested))
    return iter(())


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


def adjusted(device: str) -> np.ndarray:
    """Low NCPAs of an instrument with other pixels, which are followed; and what explains it otherwise."""
    case = cases.settings(34, pupil_samples=48, pixel_scale_mas=9.75)
    nolls = tuple(TRUE_NM)
    image = PsfModel(cases.settings(34, pupil_samples=48), nolls).images(cases.vector(TRUE_NM, nolls))
    images = cases.draw_frames(image.double().numpy() * 1e6, 16, seed=5)
    frames = Frames(images, cases.everything(images), cases.READ_NOISE)
    options = CalibrationOptions(max_iterations=3, prior=cases.PRIOR)
    few, ghost = replace(options, highest_noll=HIGHEST_NOLL), Ghost((0.01, 60.0, 0.0))
    free = {"adjustable": [PlateScale(9.75), ghost], "adjust_always": True}
    found = calibrate(frames, case, options, **free, device=device)
    assert "plate_scale" in found.effects
    fit = calibrate(frames, case, few, device=device).fit
    causes = causes_of_misfit(fit.problem, fit.x, Asked(CONDITIONS, 0.1, np.nan))
    return np.array([*found.zernike_nm[:5], *(one.explains for one in causes)])


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
        without_blocks_of_time(cube()),
        Exposures(cube(), CONDITIONS).view(range(2, HIGHEST_NOLL + 1), device),
    )
    fitted = Fitter([view], parts.training).fit([TipTiltJitter()])
    optimum = Optimum(parts.training, fitted)
    some = [
        one
        for one in families(Moments({0: Moment("", "", CONDITIONS)}), [])[0]
        if one.effect.name in ("plate_scale", "diversity_error")
    ]
    gains = [score.gain for score in scores(optimum, some)]
    drift = measure_drift(parts.training, fitted, sure=5.0)
    companions = copy_gains(optimum, fitted.image_e.reshape(1, *CONDITIONS.settings.window)).max()
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
    "adjusted": adjusted,
    "lift": estimated_by_lift,
    "bound": bounded,
    "diagnose": diagnosed,
    "prior": law,
    **{name: lambda device, name=name: with_effect(name, device) for name in STRONG},
}


@pytest.fixture
def small_card(monkeypatch):
    """A card whose pieces are those of a processor."""
    monkeypatch.setattr(parallel, "_gpu_bytes", lambda: parallel.PROCESSOR_BYTES)


@pytest.mark.slow
@pytest.mark.usefixtures("small_card")
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
@pytest.mark.usefixtures("small_card")
def test_no_stage_mixes_tensors_of_two_devices(monkeypatch, tmp_path):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    told = ["run", "diagnose_ramp", "--samples", "--output", str(tmp_path), "--device", "cuda", "--jobs", "1"]
    with StandInDevice() as device, without_report():
        result = invoke(*told)
    assert result.exit_code == 0, result.stderr
    assert device.operations > 10_000
