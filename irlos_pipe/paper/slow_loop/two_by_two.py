"""The four images of the 2x2 mode as the loop's sensor: the baseline that LIFT on one image replaces.

Both ways to measure their defocus are given the star's photons through the same sky, and are told their own
zero without any error, as a perfect reference source would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.centroids import modes_of_centroids_nm
from irlos_pipe.estimate.ramp_fit import ramp_effects
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.paper.common.observation import model_effects_of, settings_of
from irlos_pipe.paper.common.ramps import TTF
from irlos_pipe.paper.slow_loop.frames import FrameTable
from irlos_pipe.paper.slow_loop.sensor import FARTHEST_NM, FocusSensor
from irlos_pipe.simulate.scene import Scene

CENTROIDS, LIFT = "centroids_2x2", "lift_2x2"
TWO_BY_TWO = (CENTROIDS, LIFT)
DRAWS = 400  # whose scatter is known to 4 %
WEIGHTS = NoiseModel(1.0, 1.0)  # of the pixels of an image without noise


@dataclass(frozen=True)
class CentroidSensor:
    """Centres of light of four images above a threshold: the classical 2x2 Shack–Hartmann sensor.

    Attributes
    ----------
    scene : Scene
        In the 2x2 mode.
    model : FocusSensor
        Of the same images, for their bound.
    zero_nm : float
        What it measures where there is no defocus [nm RMS].
    """

    scene: Scene
    model: FocusSensor
    zero_nm: float = 0.0

    def measure(self, images_e: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """See `FocusSensor.measure`."""
        geometry, scale_mas = self.scene.geometry, self.scene.pixel_scale_mas
        modes_nm = modes_of_centroids_nm(images_e, geometry, scale_mas, float(np.sqrt(noise.floor_e2)), TTF)
        defocus_nm = modes_nm[:, TTF.index(DEFOCUS)] - self.zero_nm
        return np.where(np.abs(defocus_nm) < FARTHEST_NM, defocus_nm, np.nan)

    def bound_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """See `FocusSensor.bound_nm`: that of any estimate from these images."""
        return self.model.bound_nm(seen_e, noise)

    def photon_noise_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """See `FocusSensor.photon_noise_nm`: the scatter of drawn images, which is above the bound."""
        image_model = self.model.model
        image = image_model.psf.images(torch.zeros(1, len(TTF), dtype=torch.float64), image_model.optics)
        mean_e = image.double().cpu().numpy()
        mean_e *= seen_e / mean_e.sum()
        scatter_e = np.sqrt(noise.excess_noise_factor * mean_e + noise.floor_e2)
        drawn_e = mean_e + scatter_e * np.random.default_rng(0).standard_normal((DRAWS, *mean_e.shape[1:]))
        return float(np.nanstd(self.measure(drawn_e, noise)))


Sensor = FocusSensor | CentroidSensor


def two_by_two_sensors(scene: Scene) -> dict[str, Sensor]:
    """Return both sensors of a `scene` in the 2x2 mode, their zero at nothing."""
    settings = settings_of(scene).for_broad_images().for_single_frames()
    model = ImageModel(light_path(settings, TTF), ramp_effects(model_effects_of(scene), {}))
    four = FocusSensor(model)
    return {CENTROIDS: CentroidSensor(scene, four), LIFT: four}


def with_their_zero(sensors: dict[str, Sensor], table: FrameTable) -> dict[str, Sensor]:
    """Return the same sensors, their zero taken from the mean of all frames without defocus and noise.

    Parameters
    ----------
    sensors : dict of str to Sensor
    table : FrameTable
        Of the images that they see.
    """
    frames = table.series_e.shape[1]
    mean_e = np.mean([table.images_e(frame, np.zeros(1)) for frame in range(frames)], axis=0)
    zeros = {name: float(one.measure(mean_e, WEIGHTS)[0]) for name, one in sensors.items()}
    return {name: replace(one, zero_nm=zeros[name]) for name, one in sensors.items()}
