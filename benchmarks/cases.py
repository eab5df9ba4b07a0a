"""The timed cases; ``python -m benchmarks.cases NAME FOLDER FRAMES THREADS`` runs one and prints JSON.

A case returns a dict: ``wall_s`` and ``cpu_s`` of all its frames together, ``frames``, and where
there is a truth ``estimates_nm`` (frames, modes) or ``error_nm``. Building a model from the
instrument is not timed, except where `calibrate` does so itself.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from irlos_pipe.estimate.calibration import CalibrationOptions, calibrate
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.frame_settings import frame_settings
from irlos_pipe.estimate.lift import LiftOptions, lift
from irlos_pipe.estimate.ramp_fit import fit_ramp
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.image_model import ImageModel
from irlos_pipe.noise import NoiseModel
from irlos_pipe.parallel import set_workers
from irlos_pipe.psf import PsfModel
from irlos_pipe.psf_settings import PsfSettings
from irlos_pipe.stages.calibrate import Config as CalibrateConfig
from irlos_pipe.stages.light_path import psf_settings
from irlos_pipe.stages.model_effects import model_effects
from irlos_pipe.stages.ramp_input import (
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)
from irlos_pipe.stages.recordings import recordings_from_product

from .frames import DIVERSITY_NM, NOLLS, PIXEL_SCALE_MAS, READ_NOISE_E, WAVELENGTH_NM, WINDOW_PX
from .inputs import Inputs, true_zernike_nm
from .long_recording import stream_10000
from .measure import peak_mib, stopwatch

MORE_NOLLS = tuple(range(2, 62))
TWO_WAVELENGTHS = ((1215.0, 0.5), (1625.0, 0.5))


def _calibrated(
    inputs: Inputs, count: int, method: str, highest_noll: int = NOLLS[-1], device: str = "cpu"
) -> dict:
    """A method of `calibrate` on the drawn frames."""
    options = CalibrationOptions(method, highest_noll=highest_noll)
    calibrate(inputs.calibration_frames(2), inputs.settings, options, device=device)  # libraries start up
    with stopwatch() as watch:
        result = calibrate(inputs.calibration_frames(count), inputs.settings, options, device=device)
    return _timed(watch, count) | {
        "estimates_nm": result.frames_nm[:, : len(NOLLS)].tolist(),
        "iterations": result.iterations.tolist(),
        "converged": result.frame_status.count("converged"),
    }


def dip_global(inputs: Inputs, count: int) -> dict:
    """The paper's method 3 with this project's model and solver."""
    return _calibrated(inputs, count, "dip_global")


def dip_global_60(inputs: Inputs, count: int) -> dict:
    """The same with 60 modes, of which those are compared that have a truth."""
    return _calibrated(inputs, count, "dip_global", MORE_NOLLS[-1])


def dip_global_cuda(inputs: Inputs, count: int) -> dict:
    """`dip_global` on a GPU; how long it takes is for the wall clock to say."""
    return _calibrated(inputs, count, "dip_global", device="cuda") | {"clock": "wall_s"}


def dip_global_60_cuda(inputs: Inputs, count: int) -> dict:
    """The same with 60 modes."""
    return _calibrated(inputs, count, "dip_global", MORE_NOLLS[-1], "cuda") | {"clock": "wall_s"}


def lift_slices(inputs: Inputs, count: int) -> dict:
    """Noise-weighted fits of every frame: the estimator that `solvephase` has, too."""
    return _calibrated(inputs, count, "lift_slices")


def fft_lbfgs(inputs: Inputs, count: int, nolls: tuple[int, ...] = NOLLS) -> dict:
    """Padded FFT, autograd, L-BFGS."""
    from .baseline_fft import FftModel, fit

    model = FftModel(inputs.settings.geometry, nolls, DIVERSITY_NM, WAVELENGTH_NM, PIXEL_SCALE_MAS, WINDOW_PX)
    images_e = torch.as_tensor(inputs.frames.images_e[:count])
    model.images(torch.zeros(1, len(nolls)))
    with stopwatch() as watch:
        estimates_nm, evaluations = fit(model, images_e)
    known_nm = estimates_nm[:, : len(NOLLS)].tolist()
    return _timed(watch, count) | {"estimates_nm": known_nm, "evaluations": evaluations}


def fft_lbfgs_60(inputs: Inputs, count: int) -> dict:
    """The same with 60 modes."""
    return fft_lbfgs(inputs, count, MORE_NOLLS)


def solvephase_lm(inputs: Inputs, count: int) -> dict:
    """`solvephase`, 29 modes per frame."""
    from .baseline_solvephase import SolvephaseFit

    fitter = SolvephaseFit(inputs.settings, len(NOLLS), READ_NOISE_E, "gaussian")
    fitter.fit_nm(inputs.frames.images_e[0])
    with stopwatch() as watch:
        estimates_nm = fitter.fit_all_nm(inputs.frames.images_e[:count])
    return _timed(watch, count) | {"estimates_nm": estimates_nm.tolist()}


def long_exposure(inputs: Inputs, count: int) -> dict:
    """The default method on ``data_samples/calibration-sky``."""
    context = inputs.context
    recording = recordings_from_product(context.products["ingest"], CalibrateConfig().input)[0].accepted()
    frames = Frames(
        torch.as_tensor(recording.images_e[:count]),
        torch.as_tensor(recording.pixel_mask),
        NoiseModel.of(recording),
    )
    with stopwatch() as watch:
        result = calibrate(
            frames,
            psf_settings(context.instrument, context.model, recording),
            CalibrationOptions(),
            model_effects(context.instrument, context.model, recording),
        )
    truth = true_zernike_nm("calibration-sky")
    found = dict(zip(result.nolls, result.zernike_nm, strict=True))
    error_nm = float(np.linalg.norm([found[noll] - truth[noll] for noll in NOLLS]))
    return _timed(watch, len(frames.images_e)) | {"error_nm": error_nm}


def prepared_ramp(inputs: Inputs, halo: str) -> Callable[[], tuple[float, int]]:
    """LIFT of the ramp's frames in one batch: three modes, J+H, NCPAs as calibrated.

    Parameters
    ----------
    halo : {"calibrated", "off"}
        AO residual and jitter as calibrated, or neither.

    Returns
    -------
    callable
        Fits, and returns the RMS error of the defocus [nm] and the number of frames.
    """
    context, ncpa_nm = inputs.context, calibrated_ncpa_nm(inputs.context)
    ramp = read_ramp(context, context.config.input)
    model = ramp_model(context, ramp, context.config.modes, ncpa_nm)
    effects = [] if halo == "off" else effects_for_lift(context, ramp.recordings[0], halo, "calibrated")
    start_nm = ramp_start(context, model, ramp, ncpa_nm, context.config.start)

    def fit() -> tuple[float, int]:
        found = fit_ramp(model, ramp.data, start_nm, LiftOptions(), effects).result
        return _rms(found.mode(4)[0].numpy() - ramp.data.introduced_nm), len(ramp.names)

    return fit


def _lift_ramp(inputs: Inputs, halo: str) -> dict:
    fit = prepared_ramp(inputs, halo)
    with stopwatch() as watch:
        error_nm, frames = fit()
    return _timed(watch, frames) | {"error_nm": error_nm}


def lift_ramp(inputs: Inputs, count: int) -> dict:
    """All frames of the ramp with the full model."""
    return _lift_ramp(inputs, "calibrated")


def lift_ramp_bare(inputs: Inputs, count: int) -> dict:
    """The same without AO residual and jitter, which `solvephase` does not have."""
    return _lift_ramp(inputs, "off")


def _lift_one_by_one(inputs: Inputs, count: int, build: Callable[[PsfSettings, float], object]) -> dict:
    """Another implementation on frames spread over the ramp, same NCPAs; none knows an AO residual."""
    context = inputs.context
    ramp = read_ramp(context, context.config.input)
    settings = psf_settings(
        context.instrument, context.model, ramp.recordings[0], calibrated_ncpa_nm(context)
    )
    fitter = build(settings, ramp.acquisition.detector.read_noise_e)
    chosen = np.linspace(0, len(ramp.names) - 1, count).astype(int)
    fitter.fit_nm(ramp.data.images_e[0].numpy())
    with stopwatch() as watch:
        estimates_nm = fitter.fit_all_nm(ramp.data.images_e[chosen].numpy())
    return _timed(watch, count) | {"error_nm": _rms(estimates_nm[:, 2] - ramp.data.introduced_nm[chosen])}


def lift_solvephase(inputs: Inputs, count: int) -> dict:
    """`solvephase`'s LIFT."""
    from .baseline_solvephase import SolvephaseFit

    return _lift_one_by_one(inputs, count, lambda case, noise: SolvephaseFit(case, 3, noise, "poisson"))


def lift_numpy(inputs: Inputs, count: int) -> dict:
    """Gauss-Newton with NumPy's FFT, as the paper's code."""
    from .baseline_numpy_lift import NumpyLift

    return _lift_one_by_one(inputs, count, lambda case, noise: NumpyLift(case, (2, 3, 4), noise))


def lift_latency(inputs: Inputs, count: int) -> dict:
    """One frame at a time, three modes, two wavelengths, no AO residual."""
    settings = PsfSettings(
        inputs.settings.geometry, (WINDOW_PX, WINDOW_PX), PIXEL_SCALE_MAS, TWO_WAVELENGTHS, DIVERSITY_NM
    )
    model = PsfModel(frame_settings(settings), (2, 3, 4))
    frames = inputs.calibration_frames(1)
    truth_nm = torch.tensor([[20.0, -30.0, 100.0]])
    image_e = torch.poisson(
        model.images(truth_nm).clamp_min(0) * 1e5, generator=torch.Generator().manual_seed(1)
    )
    start_nm, times_s = torch.zeros_like(truth_nm), []
    table = tabulated(ImageModel(model), start_nm)  # built once, before the loop is closed
    for _ in range(count):
        with stopwatch() as watch:
            lift(table, image_e, frames.pixel_mask, frames.noise, start_nm)
        times_s.append((watch.wall_s, watch.cpu_s))
    wall_s, cpu_s = np.array(times_s).T
    return {
        "frames": count,
        "wall_s": float(wall_s.sum()),
        "cpu_s": float(cpu_s.sum()),
        "median_ms": float(np.median(wall_s) * 1e3),
        "p99_ms": float(np.percentile(wall_s, 99) * 1e3),
    }


def sensitivity_scan(inputs: Inputs, count: int) -> dict:
    """The paper's sensitivity scan, `count` fits in all."""
    from .sensitivity import SensitivityScan

    scan = SensitivityScan(inputs, count)
    with stopwatch() as watch:
        bright_nm = scan.curves()
    return _timed(watch, scan.fits) | {"bright_nm": bright_nm}


def _model_case(inputs: Inputs, count: int, jacobian: bool) -> dict:
    """Images, or images and Jacobians, of 29 modes at one wavelength."""
    model = PsfModel(inputs.settings, NOLLS)
    evaluate = model.images_and_jacobian if jacobian else model.images
    coefficients = torch.as_tensor(inputs.frames.truth_nm[:16])
    evaluate(coefficients)
    with stopwatch() as watch:
        for _ in range(count // 16):
            evaluate(coefficients)
    return _timed(watch, count // 16 * 16)


def model_images(inputs: Inputs, count: int) -> dict:
    """Forward model only."""
    return _model_case(inputs, count, jacobian=False)


def model_jacobian(inputs: Inputs, count: int) -> dict:
    """Forward model with the derivatives of 29 modes."""
    return _model_case(inputs, count, jacobian=True)


def _timed(watch, frames: int) -> dict:
    return {"frames": frames, "wall_s": watch.wall_s, "cpu_s": watch.cpu_s}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


CASES: dict[str, Callable[[Inputs, int], dict]] = {
    case.__name__: case
    for case in (
        dip_global,
        dip_global_60,
        dip_global_cuda,
        dip_global_60_cuda,
        lift_slices,
        fft_lbfgs,
        fft_lbfgs_60,
        solvephase_lm,
        long_exposure,
        lift_ramp,
        lift_ramp_bare,
        lift_solvephase,
        lift_numpy,
        lift_latency,
        sensitivity_scan,
        model_images,
        model_jacobian,
        stream_10000,
    )
}


if __name__ == "__main__":
    name, folder, frames, threads = sys.argv[1:]
    set_workers(int(threads))
    imported_mib = peak_mib()
    outcome = CASES[name](Inputs(Path(folder)), int(frames))
    print(json.dumps(outcome | {"peak_mib": peak_mib(), "imported_mib": imported_mib}))
