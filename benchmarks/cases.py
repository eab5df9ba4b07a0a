"""The timed cases; ``python -m benchmarks.cases NAME FOLDER FRAMES THREADS`` runs one and prints JSON.

A case returns a dict: ``wall_s`` and ``cpu_s`` of all its frames together, ``frames``, and where
there is a truth ``estimates_nm`` (frames, modes) or ``error_nm``. Building a model from the
instrument is not timed, except where `calibrate` does so itself.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.frames import DIVERSITY_NM, NOLLS, PIXEL_SCALE_MAS, READ_NOISE_E, WAVELENGTH_NM, WINDOW_PX
from benchmarks.inputs import Inputs, true_zernike_nm
from benchmarks.lift_cases import lift_bare, lift_halo, lift_latency, lift_numpy, lift_solvephase
from benchmarks.long_recording import stream_10000
from benchmarks.measure import peak_mib, stopwatch
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.parallel import workers
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.effects import model_effects
from irlos_pipe.stages.model.recording_settings import psf_settings

MORE_NOLLS = tuple(range(2, 62))


def _calibrated(inputs: Inputs, count: int, method: str, highest_noll: int = NOLLS[-1]) -> dict:
    """A method of `calibrate` on the drawn frames."""
    options, device = CalibrationOptions(method, highest_noll=highest_noll, prior=inputs.prior), inputs.device
    calibrate(inputs.calibration_frames(2), inputs.settings, options, device=device)  # libraries start up
    with stopwatch() as watch:
        result = calibrate(inputs.calibration_frames(count), inputs.settings, options, device=device)
    return watch.over(count) | {
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


def lift_slices(inputs: Inputs, count: int) -> dict:
    """Noise-weighted fits of every frame: the estimator that `solvephase` has, too."""
    return _calibrated(inputs, count, "lift_slices")


def fft_lbfgs(inputs: Inputs, count: int, nolls: tuple[int, ...] = NOLLS) -> dict:
    """Padded FFT, autograd, L-BFGS."""
    from benchmarks.baseline_fft import FftModel, fit

    model = FftModel(inputs.settings.geometry, nolls, DIVERSITY_NM, WAVELENGTH_NM, PIXEL_SCALE_MAS, WINDOW_PX)
    images_e = torch.as_tensor(inputs.frames.images_e[:count])
    model.images(torch.zeros(1, len(nolls)))
    with stopwatch() as watch:
        estimates_nm, evaluations = fit(model, images_e)
    known_nm = estimates_nm[:, : len(NOLLS)].tolist()
    return watch.over(count) | {"estimates_nm": known_nm, "evaluations": evaluations}


def fft_lbfgs_60(inputs: Inputs, count: int) -> dict:
    """The same with 60 modes."""
    return fft_lbfgs(inputs, count, MORE_NOLLS)


def solvephase_lm(inputs: Inputs, count: int) -> dict:
    """`solvephase`, 29 modes per frame."""
    from benchmarks.baseline_solvephase import SolvephaseFit

    fitter = SolvephaseFit(inputs.settings, len(NOLLS), READ_NOISE_E, "gaussian")
    fitter.fit_nm(inputs.frames.images_e[0])
    with stopwatch() as watch:
        estimates_nm = fitter.fit_all_nm(inputs.frames.images_e[:count])
    return watch.over(count) | {"estimates_nm": estimates_nm.tolist()}


def long_exposure(inputs: Inputs, count: int) -> dict:
    """The default method on ``data_samples/calibration-sky``."""
    context = inputs.context
    recording = recordings_from_product(context.products["ingest"], CalibrateConfig().input)[0].accepted()
    frames = Frames(
        torch.as_tensor(recording.images_e[:count]),
        torch.as_tensor(recording.good),
        NoiseModel.of(recording),
    )
    with stopwatch() as watch:
        result = calibrate(
            frames,
            psf_settings(context.instrument, context.model, recording),
            CalibrationOptions(prior=inputs.prior),
            model_effects(context.instrument, context.model, recording),
            device=inputs.device,
        )
    truth = true_zernike_nm("calibration-sky")
    found = dict(zip(result.nolls, result.zernike_nm, strict=True))
    error_nm = float(np.linalg.norm([found[noll] - truth[noll] for noll in NOLLS]))
    return watch.over(len(frames.images_e)) | {"error_nm": error_nm}


def sensitivity_scan(inputs: Inputs, count: int) -> dict:
    """The paper's sensitivity scan, `count` fits in all."""
    from benchmarks.sensitivity import SensitivityScan

    scan = SensitivityScan(inputs, count)
    with stopwatch() as watch:
        bright_nm = scan.curves()
    return watch.over(scan.fits) | {"bright_nm": bright_nm}


def _model_case(inputs: Inputs, count: int, jacobian: bool) -> dict:
    """Images, or images and Jacobians, of 29 modes at one wavelength."""
    model = PsfModel(inputs.settings, NOLLS)
    evaluate = model.images_and_jacobian if jacobian else model.images
    coefficients = torch.as_tensor(inputs.frames.truth_nm[:16])
    evaluate(coefficients)
    with stopwatch() as watch:
        for _ in range(count // 16):
            evaluate(coefficients)
    return watch.over(count // 16 * 16)


def model_images(inputs: Inputs, count: int) -> dict:
    """Forward model only."""
    return _model_case(inputs, count, jacobian=False)


def model_jacobian(inputs: Inputs, count: int) -> dict:
    """Forward model with the derivatives of 29 modes."""
    return _model_case(inputs, count, jacobian=True)


def dip_global_cuda(inputs: Inputs, count: int) -> dict:
    """`dip_global` on a GPU."""
    return _on_gpu(dip_global, inputs, count)


def dip_global_60_cuda(inputs: Inputs, count: int) -> dict:
    """The same with 60 modes."""
    return _on_gpu(dip_global_60, inputs, count)


def long_exposure_cuda(inputs: Inputs, count: int) -> dict:
    """The default method on a GPU, for the second time: libraries start up with the first."""
    _on_gpu(long_exposure, inputs, count)
    return _on_gpu(long_exposure, inputs, count)


def lift_halo_cuda(inputs: Inputs, count: int) -> dict:
    """LIFT with the full model on a GPU."""
    return _on_gpu(lift_halo, inputs, count)


def _on_gpu(case: Callable[[Inputs, int], dict], inputs: Inputs, count: int) -> dict:
    """A case on a GPU, where the wall clock counts: the processor waits, as busy as if it worked."""
    return case(replace(inputs, device="cuda"), count) | {"clock": "wall_s"}


CASES: dict[str, Callable[[Inputs, int], dict]] = {
    case.__name__: case
    for case in (
        dip_global,
        dip_global_60,
        dip_global_cuda,
        dip_global_60_cuda,
        long_exposure_cuda,
        lift_halo_cuda,
        lift_slices,
        fft_lbfgs,
        fft_lbfgs_60,
        solvephase_lm,
        long_exposure,
        lift_bare,
        lift_halo,
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
    imported_mib = peak_mib()
    with workers(int(threads)):
        outcome = CASES[name](Inputs(Path(folder)), int(frames))
    print(json.dumps(outcome | {"peak_mib": peak_mib(), "imported_mib": imported_mib}))
