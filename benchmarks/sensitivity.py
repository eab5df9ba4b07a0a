"""The paper's sensitivity scan: offsets, magnitudes and realisations."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch

from benchmarks.inputs import Inputs
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp, start_from_defocus
from irlos_pipe.estimate.sensitivity import Criterion, scan
from irlos_pipe.stages.lift.input import calibrated_ncpa_nm, effects_for_lift, ramp_model, read_ramp

REACH_NM, MAGNITUDES, FAINTEST_MAG_J, REALISATIONS = 170.0, 11, 19.0, 10
MODES = (2, 3, 4), (2, 3, 4, 5, 7, 8, 9, 10, 11)
CONFIGURATIONS = tuple(product((True, False), MODES))
PRIOR = 0.8  # the start in units of the introduced defocus: as far off as the elongation prior
SEED = 11


class SensitivityScan:
    """All curves on frames drawn from the model of the ramp in ``data_samples``, one per offset.

    Parameters
    ----------
    fits : int
        As many as there are to be in all.
    """

    def __init__(self, inputs: Inputs, fits: int):
        self.context, self.ncpa_nm = inputs.context, calibrated_ncpa_nm(inputs.context)
        self.ramp = read_ramp(self.context, self.context.config.input)
        per_curve = max(1, fits // (MAGNITUDES * len(CONFIGURATIONS)))
        self.realisations = min(REALISATIONS, per_curve)
        self.introduced_nm = np.linspace(-REACH_NM, REACH_NM, per_curve // self.realisations)
        self.fits = len(self.introduced_nm) * self.realisations * MAGNITUDES * len(CONFIGURATIONS)
        self.data = self._drawn()

    def curves(self) -> list[float]:
        """Run the scan; returns the median error of the brightest star of every configuration [nm]."""
        return [self._curve(*configuration) for configuration in CONFIGURATIONS]

    def _curve(self, calibrated: bool, nolls: tuple[int, ...]) -> float:
        ramp, data = self.ramp, self.data
        model = ramp_model(self.context, ramp, nolls, self.ncpa_nm if calibrated else {})
        start_nm = start_from_defocus(model, data, PRIOR * self.introduced_nm)
        bright = fit_ramp(model, data, start_nm, LiftOptions(), self._effects(calibrated))
        mag_j = ramp.acquisition.mag_j
        curve = scan(
            bright.model,
            data,
            bright.result.model_e,
            mag_j,
            np.linspace(mag_j, FAINTEST_MAG_J, MAGNITUDES),
            self.realisations,
            start_nm,
            Criterion(np.inf, 1.0),
            SEED,
            near_nm=bright.result.zernike_nm,
        )
        return float(curve.median_abs_error_nm[0])

    def _effects(self, calibrated: bool) -> list[Effect]:
        recording = self.ramp.recordings[0]
        return effects_for_lift(self.context, recording, "calibrated", "calibrated", calibrated=calibrated)

    def _drawn(self) -> RampData:
        """A bright frame per offset, with photon noise."""
        real, model = self.ramp.data, ramp_model(self.context, self.ramp, MODES[0], self.ncpa_nm)
        modes_nm = torch.zeros(len(self.introduced_nm), 3, dtype=torch.float64)
        modes_nm[:, 2] = torch.as_tensor(self.introduced_nm)
        flux_e = real.images_e.double().sum((1, 2)).median().expand(len(modes_nm))
        image_model = ImageModel(model, self._effects(calibrated=True))
        background_e = torch.zeros_like(flux_e)
        mean_e = image_model.predict(modes_nm, flux_e, background_e, image_model.effects.starts).clamp_min(0)
        images_e = torch.poisson(mean_e, generator=torch.Generator().manual_seed(SEED)).float()
        return RampData(images_e, real.good, real.noise, self.introduced_nm)
