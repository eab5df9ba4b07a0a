"""From how far LIFT finds the defocus of a single frame, by where its iteration starts.

A sample is a ramp: one set of NCPAs, known as well as a calibration knows them, and a number of frames of
random defocus, pointing and AO residual. Every frame is estimated from every start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.effects import expected
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import METHODS
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, start_from_defocus
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.broad_band import J_AND_H, frame_settings, star_scene
from irlos_pipe.paper.common.cube import NCPA_NM
from irlos_pipe.paper.common.observation import images_of, model_effects_of, noise_of
from irlos_pipe.paper.common.ramps import TTF, elongation_defocus_nm, from_every_start
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene

FOCUS = TTF.index(DEFOCUS)


@dataclass(frozen=True)
class CaptureSample:
    """Frames that share their NCPAs.

    Attributes
    ----------
    reach_nm : float
        Defocus is uniform within ± this.
    shift_px : float
        The star lies within ± this of the window's centre, along x and y.
    calibration_error_nm : float
        Of the NCPAs, over all calibrated modes.
    h_alone : bool
        Whether the light is that of H, half of that of J and H.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    frames: int
    reach_nm: float
    shift_px: float
    mag_j: float
    seeing_arcsec: float
    calibration_error_nm: float
    h_alone: bool = False


@dataclass(frozen=True)
class Ramp:
    """Frames and what an observer knows of them.

    Attributes
    ----------
    scene : Scene
        Of the first frame; its NCPAs and defocus are not used.
    data : RampData
        Its introduced defocus is the truth: with that of the AO residual, without the NCPAs.
    known_ncpa_nm : dict of int to float
    """

    scene: Scene
    data: RampData
    known_ncpa_nm: dict[int, float]


def capture(sample: CaptureSample) -> dict[str, np.ndarray]:
    """Estimate every frame from every start.

    Returns
    -------
    dict of str to ndarray
        ``true_nm`` (frames,), and for every start ``<start>/defocus_nm``, ``/start_nm``, ``/sigma_nm``,
        ``/converged`` and ``/chi2_nu``, (frames,) each.
    """
    ramp = simulate_ramp(sample)
    psf = PsfModel(frame_settings(ramp.scene, ramp.known_ncpa_nm), TTF)
    model = ImageModel(psf, expected(model_effects_of(ramp.scene)))
    prior_nm = elongation_defocus_nm(ramp.scene, ramp.data) - ramp.known_ncpa_nm.get(DEFOCUS, 0.0)
    elongation_nm = start_from_defocus(psf, ramp.data, prior_nm)
    found = {"true_nm": ramp.data.introduced_nm}
    for name, estimates in from_every_start(model, ramp.data, elongation_nm, LiftOptions()).items():
        found |= {f"{name}/{key}": value for key, value in _numbers(*estimates).items()}
    return found


def _numbers(start_nm: torch.Tensor, result: LiftResult) -> dict[str, np.ndarray]:
    defocus, sigma = result.mode(DEFOCUS)
    return {
        "defocus_nm": defocus.numpy(),
        "sigma_nm": sigma.numpy(),
        "start_nm": start_nm[:, FOCUS].numpy(),
        "converged": result.solution.converged.numpy(),
        "chi2_nu": result.chi2_nu.numpy(),
    }


# -- simulation ------------------------------------------------------------------------------------


def simulate_ramp(sample: CaptureSample) -> Ramp:
    """Return the frames of a sample; every one has a sky of its own."""
    rng = np.random.default_rng(sample.seed)
    ncpa_nm = draw_ncpa_nm(rng, sample.facility.ncpa_law, NCPA_NM)
    introduced_nm = rng.uniform(-sample.reach_nm, sample.reach_nm, sample.frames)
    shifts_px = rng.uniform(-sample.shift_px, sample.shift_px, (sample.frames, 2))
    scenes = [
        _frame_scene(sample, index, ncpa_nm, shift, float(defocus))
        for index, (defocus, shift) in enumerate(zip(introduced_nm, shifts_px, strict=True))
    ]
    exposed = [expose(scene) for scene in scenes]
    focus = [one.zernike_nm[0, DEFOCUS - 2] - ncpa_nm[DEFOCUS] for one in exposed]
    images = torch.cat([images_of(scene, one) for scene, one in zip(scenes, exposed, strict=True)])
    good = torch.ones(images.shape[1:], dtype=torch.bool)
    data = RampData(images, good, noise_of(scenes[0]), introduced_nm + np.array(focus))
    return Ramp(scenes[0], data, _known_ncpa_nm(rng, ncpa_nm, sample.calibration_error_nm))


def _frame_scene(
    sample: CaptureSample, index: int, ncpa_nm: dict[int, float], shift_px: np.ndarray, defocus_nm: float
) -> Scene:
    scene = star_scene(
        f"{sample.name}, frame {index}",
        sample.facility,
        (*sample.seed, index),
        1,
        sample.mag_j,
        ncpa_nm,
        defocus_nm,
        seeing_arcsec=sample.seeing_arcsec,
    )
    pixel_nm = tilt_nm(scene.pixel_scale_mas, sample.facility.pupil.diameter_m)
    tilts_nm = {noll: ncpa_nm[noll] + float(px) * pixel_nm for noll, px in zip((2, 3), shift_px, strict=True)}
    scene = replace(scene, ncpa_nm={**ncpa_nm, **tilts_nm})
    if not sample.h_alone:
        return scene
    h = J_AND_H[-1]
    return replace(scene, bands=(Band.of(h),), throughput=scene.throughput * h.share)


def _known_ncpa_nm(rng: np.random.Generator, ncpa_nm: dict[int, float], error_nm: float) -> dict[int, float]:
    """NCPAs as calibrated: an error of the same size in all modes that the default calibration estimates."""
    nolls = range(2, METHODS[DEFAULT].highest_noll + 1)
    errors = error_nm / np.sqrt(len(nolls)) * rng.standard_normal(len(nolls))
    return {noll: ncpa_nm.get(noll, 0.0) + float(error) for noll, error in zip(nolls, errors, strict=True)}
