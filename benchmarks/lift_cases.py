"""The timed cases of LIFT: three modes of single frames, by this project and by others.

All fit the same images: the ramp of ``data_samples`` as if its star were dimmer, `REALISATIONS` times with
noise of its own. Errors are those of the defocus against what was introduced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from benchmarks.frames import DIVERSITY_NM, PIXEL_SCALE_MAS, WINDOW_PX
from benchmarks.inputs import Inputs
from benchmarks.measure import stopwatch
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.estimate.sensitivity import dim
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)
from irlos_pipe.stages.model.recording_settings import psf_settings

REALISATIONS, FACTOR, SEED = 10, 0.5, 5
REPEATS = 5  # of fits that take less than a second; the median counts
FEW = 3  # frames with which libraries start up before the clock does
TWO_WAVELENGTHS = ((1215.0, 0.5), (1625.0, 0.5))


@dataclass(frozen=True)
class DimmedRamp:
    """Images that all implementations fit, and what this project's LIFT starts from."""

    inputs: Inputs

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
        return start_nm.repeat(REALISATIONS, 1)

    @cached_property
    def data(self) -> RampData:
        """All images, realisation by realisation."""
        bright, frames = self.ramp.data, len(self.ramp.names)
        start_nm = self.start_nm[:frames]
        signal_e = fit_ramp(self.model, bright, start_nm, LiftOptions(), self.halo).result.model_e
        generator = torch.Generator().manual_seed(SEED)
        drawn = [dim(bright.images_e, signal_e, FACTOR, bright.noise, generator) for _ in range(REALISATIONS)]
        introduced_nm = np.tile(bright.introduced_nm, REALISATIONS)
        return replace(bright, images_e=torch.cat(drawn).float(), introduced_nm=introduced_nm)

    def first(self, count: int) -> RampData:
        """The first images; the first realisation comes first."""
        data = self.data
        return replace(data, images_e=data.images_e[:count], introduced_nm=data.introduced_nm[:count])


def prepared_lift(inputs: Inputs, count: int, with_halo: bool) -> Callable[[], dict[int, float]]:
    """This project's LIFT of so many images in one batch.

    Returns
    -------
    callable
        Fits, and returns the error of the defocus of every image [nm].
    """
    dimmed = DimmedRamp(inputs)
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


def lift_bare(inputs: Inputs, count: int) -> dict:
    """Without AO residual and jitter, which the other implementations do not have."""
    return _lift(inputs, count, with_halo=False)


def lift_halo(inputs: Inputs, count: int) -> dict:
    """With the full model."""
    return _lift(inputs, count, with_halo=True)


def _one_by_one(inputs: Inputs, count: int, build: Callable[[PsfSettings, float], object]) -> dict:
    """Another implementation on images spread over the first realisation, same NCPAs."""
    context, dimmed = inputs.context, DimmedRamp(inputs)
    settings = psf_settings(
        context.instrument, context.model, dimmed.ramp.recordings[0], ncpa_nm=dimmed.ncpa_nm
    )
    fitter = build(settings, dimmed.ramp.acquisition.detector.read_noise_e)
    chosen = np.linspace(0, len(dimmed.ramp.names) - 1, count).astype(int)
    images_e = dimmed.data.images_e[chosen].numpy()
    fitter.fit_nm(images_e[0])
    with stopwatch() as watch:
        estimates_nm = fitter.fit_all_nm(images_e)
    errors_nm = estimates_nm[:, 2] - dimmed.data.introduced_nm[chosen]
    return watch.over(count) | {"errors_nm": dict(zip(chosen.tolist(), errors_nm.tolist(), strict=True))}


def lift_solvephase(inputs: Inputs, count: int) -> dict:
    """`solvephase`'s LIFT."""
    from benchmarks.baseline_solvephase import SolvephaseFit

    return _one_by_one(inputs, count, lambda case, noise: SolvephaseFit(case, 3, noise, "poisson"))


def lift_numpy(inputs: Inputs, count: int) -> dict:
    """Gauss-Newton with NumPy's FFT, as the paper's code."""
    from benchmarks.baseline_numpy_lift import NumpyLift

    return _one_by_one(inputs, count, lambda case, noise: NumpyLift(case, (2, 3, 4), noise))


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
