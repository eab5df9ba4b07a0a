"""The timed cases; ``python -m benchmarks.cases NAME FOLDER FRAMES THREADS`` runs one and prints JSON.

A case returns a dict: ``wall_s`` and ``cpu_s`` of all its frames together, ``frames``, and where
there is a truth ``estimates_nm`` (frames, modes) or ``error_nm``. Building a model from the
instrument is not timed, except where `calibrate` does so itself.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits

from benchmarks.inputs import (
    DIVERSITY_NM,
    NOLLS,
    PIXEL_SCALE_MAS,
    READ_NOISE_E,
    RECIPES,
    SEED,
    WAVELENGTH_NM,
    WINDOW_PX,
    Inputs,
    peak_mib,
    stopwatch,
    true_zernike_nm,
)
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions, LiftOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp, start_from_defocus
from irlos_pipe.estimate.sensitivity import Configuration, Criterion, dim, scan
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.files.processes import forked_map
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.parallel import process_map, workers
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.pipeline import Selection, run_recipe
from irlos_pipe.recipe import load_recipe
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig
from irlos_pipe.stages.ingest.stage import recordings_from_product
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)
from irlos_pipe.stages.model.effects import model_effects, psf_settings

MORE_NOLLS = tuple(range(2, 62))
Case = Callable[[Inputs, int], dict]
FitNm = Callable[[np.ndarray], np.ndarray]  # coefficients of one frame [nm RMS]


# -- calibration -------------------------------------------------------------------------------


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


def solvephase_lm(inputs: Inputs, count: int) -> dict:
    """`solvephase`, 29 modes per frame."""
    from benchmarks.baseline_solvephase import SolvephaseFit

    fit_nm = SolvephaseFit(inputs.settings, len(NOLLS), READ_NOISE_E, "gaussian").fit_nm
    fit_nm(inputs.frames.images_e[0])
    with stopwatch() as watch:
        estimates_nm = np.array([fit_nm(image) for image in inputs.frames.images_e[:count]])
    return watch.over(count) | {"estimates_nm": estimates_nm.tolist()}


def long_exposure(inputs: Inputs, count: int) -> dict:
    """The default method on ``data_samples/calibration-sky``."""
    context = inputs.context
    recording = recordings_from_product(context.products["ingest"], CalibrateConfig().input)[0].accepted()
    frames = Frames(
        torch.as_tensor(recording.images_e[:count]), torch.as_tensor(recording.good), NoiseModel.of(recording)
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


# -- LIFT --------------------------------------------------------------------------------------
#
# All fit the same images: the ramp of ``data_samples`` as if its star were dimmer, over and over with noise
# of its own. Errors are those of the defocus against what was introduced.

FACTOR, DIMMED_SEED = 0.5, 5
REPEATS = 5  # repetitions of fits that take less than a second; the median counts
FEW = 3  # frames with which libraries start up before the clock does
TWO_WAVELENGTHS = ((1215.0, 0.5), (1625.0, 0.5))


@dataclass(frozen=True)
class DimmedRamp:
    """Images that all implementations fit, and what this project's LIFT starts from."""

    inputs: Inputs
    count: int = 1  # images

    @cached_property
    def realisations(self) -> int:
        return -(-self.count // len(self.ramp.names))

    @cached_property
    def ramp(self) -> Ramp:
        """The ramp as it was recorded."""
        return read_ramp(self.inputs.context, self.inputs.context.config.input)

    @cached_property
    def ncpa_nm(self) -> dict[int, float]:
        """NCPAs as calibrated."""
        return calibrated_ncpa_nm(self.inputs.context)

    @cached_property
    def model(self) -> PsfModel:
        """Tip, tilt and defocus, J+H."""
        return ramp_model(self.inputs.context, self.ramp, self.inputs.context.config.modes, self.ncpa_nm)

    @cached_property
    def halo(self) -> list[Effect]:
        """AO residual and jitter as calibrated."""
        return effects_for_lift(self.inputs.context, self.ramp.recordings[0], "calibrated", "calibrated")

    @cached_property
    def start_nm(self) -> torch.Tensor:
        """Start of every image, (images, modes): that of the frame it was made from."""
        context = self.inputs.context
        start_nm = ramp_start(context, self.model, self.ramp, self.ncpa_nm, context.config.start)
        return start_nm.repeat(self.realisations, 1)

    @cached_property
    def data(self) -> RampData:
        """All images, realisation by realisation."""
        bright, frames = self.ramp.data, len(self.ramp.names)
        start_nm = self.start_nm[:frames]
        signal_e = fit_ramp(self.model, bright, start_nm, LiftOptions(), self.halo).result.model_e
        generator = torch.Generator().manual_seed(DIMMED_SEED)
        drawn = [
            dim(bright.images_e, signal_e, FACTOR, bright.noise, generator) for _ in range(self.realisations)
        ]
        introduced_nm = np.tile(bright.introduced_nm, self.realisations)
        return replace(bright, images_e=torch.cat(drawn).float(), introduced_nm=introduced_nm)

    def first(self, count: int) -> RampData:
        """The first images; the first realisation comes first."""
        data = self.data
        return replace(data, images_e=data.images_e[:count], introduced_nm=data.introduced_nm[:count])


def prepared_lift(inputs: Inputs, count: int, with_halo: bool) -> Callable[[], dict[int, float]]:
    """LIFT of so many images in one batch by this project; returns the error of each one's defocus [nm]."""
    dimmed = DimmedRamp(inputs, count)
    data, effects = dimmed.first(count), dimmed.halo if with_halo else []

    def fit() -> dict[int, float]:
        found = fit_ramp(dimmed.model, data, dimmed.start_nm[:count], LiftOptions(), effects).result
        return dict(enumerate((found.mode(4)[0].numpy() - data.introduced_nm).tolist()))

    fit_ramp(dimmed.model, dimmed.first(FEW), dimmed.start_nm[:FEW], LiftOptions(), effects)
    return fit


def _lift(inputs: Inputs, count: int, with_halo: bool) -> dict:
    fit, watches = prepared_lift(inputs, count, with_halo), []
    for _ in range(REPEATS):
        with stopwatch() as watch:
            errors_nm = fit()
        watches.append(watch)
    median = sorted(watches, key=lambda one: one.cpu_s)[REPEATS // 2]
    return median.over(count) | {"errors_nm": errors_nm}


def _one_by_one(inputs: Inputs, count: int, build: Callable[[PsfSettings, float], FitNm]) -> dict:
    """Another implementation on images spread over the first realisation, same NCPAs."""
    context, dimmed = inputs.context, DimmedRamp(inputs)
    settings = psf_settings(
        context.instrument, context.model, dimmed.ramp.recordings[0], ncpa_nm=dimmed.ncpa_nm
    )
    fit_nm = build(settings, dimmed.ramp.acquisition.detector.read_noise_e)
    chosen = np.linspace(0, len(dimmed.ramp.names) - 1, count).astype(int)
    images_e = dimmed.data.images_e[chosen].numpy()
    fit_nm(images_e[0])
    with stopwatch() as watch:
        estimates_nm = np.array([fit_nm(image) for image in images_e])
    errors_nm = estimates_nm[:, 2] - dimmed.data.introduced_nm[chosen]
    return watch.over(count) | {"errors_nm": dict(zip(chosen.tolist(), errors_nm.tolist(), strict=True))}


def lift_solvephase(inputs: Inputs, count: int) -> dict:
    """`solvephase`'s LIFT."""
    from benchmarks.baseline_solvephase import SolvephaseFit

    return _one_by_one(inputs, count, lambda case, noise: SolvephaseFit(case, 3, noise, "poisson").fit_nm)


def lift_numpy(inputs: Inputs, count: int) -> dict:
    """Gauss-Newton with NumPy's FFT, as the paper's code."""
    from benchmarks.baseline_numpy_lift import NumpyLift

    return _one_by_one(inputs, count, lambda case, noise: NumpyLift(case, (2, 3, 4), noise).fit_nm)


def lift_latency(inputs: Inputs, count: int) -> dict:
    """One frame at a time, three modes, two wavelengths, no AO residual."""
    settings = PsfSettings(
        inputs.settings.geometry,
        (WINDOW_PX, WINDOW_PX),
        PIXEL_SCALE_MAS,
        TWO_WAVELENGTHS,
        KnownWavefront(DIVERSITY_NM),
    )
    model = PsfModel(settings.for_single_frames(), (2, 3, 4))
    frames = inputs.calibration_frames(1)
    truth_nm = torch.tensor([[20.0, -30.0, 100.0]])
    image_e = torch.poisson(
        model.images(truth_nm).clamp_min(0) * 1e5, generator=torch.Generator().manual_seed(1)
    )
    start_nm, times_s = torch.zeros_like(truth_nm), []
    table = tabulated(ImageModel(model), start_nm)  # built once, before the loop is closed
    for _ in range(count):
        with torch.inference_mode(), stopwatch() as watch:  # no bookkeeping for derivatives: a tenth
            lift(table, image_e, frames.good, frames.noise, start_nm)
        times_s.append((watch.wall_s, watch.cpu_s))
    wall_s, cpu_s = np.array(times_s).T
    return {
        "frames": count,
        "wall_s": float(wall_s.sum()),
        "cpu_s": float(cpu_s.sum()),
        "median_ms": float(np.median(wall_s) * 1e3),
        "p99_ms": float(np.percentile(wall_s, 99) * 1e3),
    }


# -- the paper's sensitivity scan: offsets, magnitudes and realisations ------------------------

REACH_NM, MAGNITUDES, FAINTEST_MAG_J, SCANNED = 170.0, 11, 19.0, 10
MODES = (2, 3, 4), (2, 3, 4, 5, 7, 8, 9, 10, 11)
CONFIGURATIONS = tuple(product((True, False), MODES))
PRIOR = 0.8  # the start in units of the introduced defocus: as far off as the elongation prior
SCAN_SEED = 11


def sensitivity_scan(inputs: Inputs, count: int) -> dict:
    """The paper's sensitivity scan, `count` fits in all.

    Frames are drawn from the model of the ramp in ``data_samples``, one per offset; `bright_nm` is the median
    error of the brightest star of every configuration.
    """
    context, ncpa_nm = inputs.context, calibrated_ncpa_nm(inputs.context)
    ramp = read_ramp(context, context.config.input)
    per_curve = max(1, count // (MAGNITUDES * len(CONFIGURATIONS)))
    realisations = min(SCANNED, per_curve)
    introduced_nm = np.linspace(-REACH_NM, REACH_NM, per_curve // realisations)
    mags_j = np.linspace(ramp.acquisition.mag_j, FAINTEST_MAG_J, MAGNITUDES)

    def effects(calibrated: bool) -> list[Effect]:
        return effects_for_lift(
            context, ramp.recordings[0], "calibrated", "calibrated", calibrated=calibrated
        )

    def fitted(configuration: tuple[bool, tuple[int, ...]]) -> Configuration:
        calibrated, nolls = configuration
        model = ramp_model(context, ramp, nolls, ncpa_nm if calibrated else {})
        start_nm = start_from_defocus(model, data, PRIOR * introduced_nm)
        return Configuration.of(fit_ramp(model, data, start_nm, LiftOptions(), effects(calibrated)))

    image_model = ImageModel(ramp_model(context, ramp, MODES[0], ncpa_nm), effects(calibrated=True))
    data = _bright_frames(image_model, ramp.data, introduced_nm)
    with stopwatch() as watch:
        curves = scan(
            process_map(fitted, CONFIGURATIONS),
            data,
            ramp.acquisition.mag_j,
            mags_j,
            realisations,
            Criterion(np.inf, 1.0),
            SCAN_SEED,
        )
    fits = len(introduced_nm) * realisations * MAGNITUDES * len(CONFIGURATIONS)
    return watch.over(fits) | {"bright_nm": [float(curve.median_abs_error_nm[0]) for curve in curves]}


def _bright_frames(model: ImageModel, real: RampData, introduced_nm: np.ndarray) -> RampData:
    """A bright frame per offset, with photon noise."""
    modes_nm = torch.zeros(len(introduced_nm), 3, dtype=torch.float64)
    modes_nm[:, 2] = torch.as_tensor(introduced_nm)
    flux_e = real.images_e.double().sum((1, 2)).median().expand(len(modes_nm))
    mean_e = model.predict(modes_nm, flux_e, torch.zeros_like(flux_e), model.effects.starts)
    images_e = torch.poisson(
        mean_e.cpu().clamp_min(0), generator=torch.Generator().manual_seed(SCAN_SEED)
    ).float()
    return RampData(images_e, real.good, real.noise, introduced_nm)


# -- a recording of thousands of frames through the pipeline: how much memory it takes ---------

PEDESTAL_ADU, E_PER_ADU = 200.0, 4.0  # the brightest speckles do not saturate
ACQUISITION = {
    "role": "ncpa_calibration",
    "exposure_s": 0.1,
    "seeing_arcsec": 0.5,
    "pixel_scale_mas": PIXEL_SCALE_MAS,
    "spectrum": [{"wavelength_nm": WAVELENGTH_NM, "weight": 1.0}],
    "diversity": {"source": "lens", "zernike": DIVERSITY_NM},
    "detector": {"e_per_adu": E_PER_ADU, "read_noise_e": READ_NOISE_E},
}


def stream_10000(inputs: Inputs, count: int) -> dict:
    """Ingest and the default calibration of a cube of so many frames, files included."""
    cube = inputs.folder / "long.fits"
    write_cube(cube, inputs.frames.images_e, count)
    recipe = load_recipe(RECIPES / "ncpa_calibration.yaml", inputs=[f"calibration={cube}"])
    with stopwatch() as watch:
        run = run_recipe(recipe, inputs.folder / "long", Selection(last="calibrate"))
    (recording,) = run.results["stages"]["ingest"]["inputs"]
    if recording["frames_rejected"]:  # which costs nothing
        raise RuntimeError(f"{recording['frames_rejected']} of {count} frames were rejected")
    return watch.over(count)


def write_cube(path: Path, images_e: np.ndarray, count: int) -> None:
    """Repeat drawn frames with further read noise as counts of a plain FITS cube, its side-car next to it."""
    rng = np.random.default_rng(SEED)
    adu = np.empty((count, *images_e.shape[1:]), np.uint16)
    for number in range(count):
        noisy_e = images_e[number % len(images_e)] + rng.normal(0.0, READ_NOISE_E, images_e.shape[1:])
        adu[number] = np.rint(noisy_e / E_PER_ADU + PEDESTAL_ADU).clip(0, 65535)
    fits.PrimaryHDU(adu).writeto(path, overwrite=True)
    path.with_suffix(".yaml").write_text(yaml_text(ACQUISITION))


# -- the forward model -------------------------------------------------------------------------


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


# -- all, by name ------------------------------------------------------------------------------


def _on_gpu(inputs: Inputs, count: int, case: Case) -> dict:
    """A case on a GPU, where the wall clock counts: the processor waits, as busy as if it worked.

    Libraries start up, and memory is reserved, with a first run.
    """
    found = [case(replace(inputs, device="cuda"), count) for _ in range(2)]
    return found[-1] | {"clock": "wall_s"}


CASES: dict[str, Case] = {
    # The paper's method 3 with this project's model and solver; of 60 modes those with a truth are compared.
    "dip_global": partial(_calibrated, method="dip_global"),
    "dip_global_60": partial(_calibrated, method="dip_global", highest_noll=MORE_NOLLS[-1]),
    # Noise-weighted fits of every frame: the estimator that `solvephase` has, too.
    "lift_slices": partial(_calibrated, method="lift_slices"),
    "fft_lbfgs": fft_lbfgs,
    "fft_lbfgs_60": partial(fft_lbfgs, nolls=MORE_NOLLS),
    "solvephase_lm": solvephase_lm,
    "long_exposure": long_exposure,
    # Without AO residual and jitter, which the other implementations do not have, and with the full model.
    "lift_bare": partial(_lift, with_halo=False),
    "lift_halo": partial(_lift, with_halo=True),
    "lift_solvephase": lift_solvephase,
    "lift_numpy": lift_numpy,
    "lift_latency": lift_latency,
    "sensitivity_scan": sensitivity_scan,
    "model_images": partial(_model_case, jacobian=False),
    "model_jacobian": partial(_model_case, jacobian=True),
    "stream_10000": stream_10000,
}
for name in ("dip_global", "dip_global_60", "long_exposure", "lift_halo", "sensitivity_scan"):
    CASES[f"{name}_cuda"] = partial(_on_gpu, case=CASES[name])


if __name__ == "__main__":
    name, folder, frames, threads = sys.argv[1:]
    imported_mib = peak_mib()
    with workers(int(threads), partial(forked_map, int(threads))):
        outcome = CASES[name](Inputs(Path(folder)), int(frames))
    print(json.dumps(outcome | {"peak_mib": peak_mib(), "imported_mib": imported_mib}))
