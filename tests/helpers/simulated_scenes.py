"""Scenes that the tests of the simulator start from: the UT4 pupil, one wavelength, 142 nm of NCPAs."""

from dataclasses import replace

import numpy as np
import torch

from helpers.optics_cases import READ_NOISE, draw_frames, everything
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Sampling, Scene, draw_ncpa_nm

FACILITY = load_instrument("irlos").facility
UT4 = FACILITY.pupil
MAS_RAD = np.deg2rad(1 / 3.6e6)
NARROW_H = (Band(1600.0, 1e-6),)
NCPA_NM = draw_ncpa_nm(np.random.default_rng(11), FACILITY.ncpa_law, 142.0)
FINE = Sampling(points_per_band=1)


def scene(*, geometry: PupilGeometry = UT4, **changes) -> Scene:
    """One frame of 0.1 s on the bench, monochromatic, unless changed; `geometry` replaces UT4's pupil."""
    usual = {
        "name": "test",
        "facility": replace(FACILITY, pupil=geometry),
        "bands": NARROW_H,
        "seed": (20, 24),
        "frames": 1,
        "exposure_s": 0.1,
        "window": (48, 48),
        "ncpa_nm": NCPA_NM,
        "diversity_nm": {6: -170.0},
        "sampling": FINE,
    }
    return Scene(**usual | changes)


def image(**changes) -> np.ndarray:
    """Mean image of the frames of `scene`, in parts of the star's light, (rows, columns) float64."""
    return of_light(expose(scene(**changes)), scene(**changes))


def sky_frames(sky: Sky, **changes) -> tuple[Frames, Exposed]:
    """Frames of 0.1 s on the sky with photon noise and read noise of 1 e-, and what was exposed."""
    exposed = expose(scene(sky=sky, sampling=replace(FINE, step_s=0.02), **changes))
    images = torch.cat([draw_frames(mean, 1, seed) for seed, mean in enumerate(exposed.mean_e)])
    return Frames(images, everything(images), READ_NOISE), exposed


def of_light(exposed: Exposed, exposed_scene: Scene) -> np.ndarray:
    return exposed.mean_e.mean(axis=0, dtype=float) / exposed_scene.photons


def tilt_nm_rms(mas: float, diameter_m: float = 8.0) -> float:
    """Noll 2 or 3 [nm RMS] that moves the image: an angle is an OPD of angle · x, and Z2 = 4 x / D."""
    return mas * MAS_RAD * diameter_m / 4 * 1e9


def worst(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference in parts of the peak."""
    return float(np.abs(found - expected).max() / expected.max())
