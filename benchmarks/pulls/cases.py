"""What is simulated: a calibration cube, and a ramp of a fainter star behind the same optics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS, HIGHEST_REPORTED_NOLL
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.lift_errors import FrameErrors, instant_error_nm, nominal_frame_chi2, optics_sigma_nm
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper.common.calibrations import DEFAULT, VARIANTS, ObservedCube
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, knowledge_of, observe, ramp_scene
from irlos_pipe.paper.common.scenes import COARSE, cube_scene
from irlos_pipe.simulate.atmosphere import Shape
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

SEEINGS_ARCSEC = (0.35, 0.5, 0.7, 1.0)
SHAPES: tuple[Shape, ...] = get_args(Shape)
MAG_J, RAMP_MAG_J = 7.0, 12.0
OFFSETS_NM, FRAMES_PER_OFFSET = (-200.0, -100.0, 0.0, 100.0, 200.0), 3
NOLLS = range(4, HIGHEST_REPORTED_NOLL + 1)  # tip and tilt are the star's place, not an aberration


@dataclass(frozen=True)
class Case:
    """One cube and its ramp; what is drawn follows from `seed` and `index`."""

    seed: int
    index: int
    frames: int

    @property
    def name(self) -> str:
        """Return the name of its file."""
        return f"{self.index:04d}"

    @property
    def seeing_arcsec(self) -> float:
        """Return the seeing: all of them in turn."""
        return SEEINGS_ARCSEC[self.index % len(SEEINGS_ARCSEC)]

    @property
    def shape(self) -> Shape:
        """Return the shape of the residual: all of them in turn."""
        return SHAPES[self.index // len(SEEINGS_ARCSEC) % len(SHAPES)]

    def scene(self) -> Scene:
        """Return the cube."""
        facility = load_instrument("irlos").facility
        seed = self.seed, self.index
        return cube_scene(self.name, seed, facility, self.seeing_arcsec, self.frames, MAG_J, self.shape)


def outcome_of(case: Case) -> dict:
    """Simulate and estimate a `case`; return errors beside what was quoted, in JSON types."""
    cube = ObservedCube.of(case.scene())
    calibration = cube.calibrated(VARIANTS[DEFAULT])
    return {
        "seed": case.seed,
        "frames": case.frames,
        "seeing_arcsec": case.seeing_arcsec,
        "shape": case.shape,
        "cube": _of_cube(cube, calibration),
        "ramp": _of_ramp(cube, calibration),
    }


def _of_cube(cube: ObservedCube, calibration: Calibration) -> dict:
    """Errors of Noll 4–30 against the static NCPAs, and against the mean wavefront of the frames."""
    own = [calibration.nolls.index(noll) for noll in NOLLS]
    found_nm, static_nm = (
        calibration.zernike_nm[own],
        np.array([cube.scene.ncpa_nm.get(n, 0.0) for n in NOLLS]),
    )
    mean_nm = cube.exposed.mean_zernike_nm()
    covariance = calibration.covariance_nm2[np.ix_(own, own)]
    error_nm = found_nm - static_nm
    return {
        "error_nm": error_nm.tolist(),
        "error_of_mean_nm": (found_nm - np.array([mean_nm[n] for n in NOLLS])).tolist(),
        "sigma_nm": np.sqrt(np.diag(covariance)).tolist(),
        "chi2": float(error_nm @ np.linalg.solve(covariance, error_nm)),
        "misfit": calibration.chi2_nu / calibration.nominal.value,
        "errors_from": calibration.errors_from,
    }


def _of_ramp(cube: ObservedCube, calibration: Calibration) -> dict:
    """Errors of the defocus of every frame, and the parts of what is quoted for it."""
    variant = LIFT_VARIANTS["default_3"]
    offsets_nm = np.repeat(OFFSETS_NM, FRAMES_PER_OFFSET)
    scene = replace(ramp_scene(cube.scene, RAMP_MAG_J, offsets_nm.tolist()), sampling=COARSE)
    scene = replace(scene, sky=cube.scene.sky)
    observed = observe(scene, expose(scene), {DEFAULT: knowledge_of(cube, calibration)})
    fit, data = observed.estimate(variant), observed.data
    photon_nm = fit.result.mode(DEFOCUS)[1].numpy()
    nominal = nominal_frame_chi2(
        data.images_e,
        fit.result.model_e,
        data.good,
        data.noise,
        offsets_nm,
        fit.result.solution.values.shape[1],
    )
    instant_nm = instant_error_nm(offsets_nm, fit.defocus_nm, photon_nm)
    errors = FrameErrors(instant_nm, float(fit.result.chi2_nu.nanmedian()), nominal)
    optics_nm = optics_sigma_nm(
        fit.model, fit.result, data.good, data.noise, calibration.nolls, calibration.covariance_nm2
    )
    return {
        "error_nm": (fit.defocus_nm - offsets_nm).tolist(),
        "sigma_nm": errors.sigma_nm(photon_nm, optics_nm).tolist(),
        "photon_nm": photon_nm.tolist(),
        "instant_nm": instant_nm,
        "optics_nm": optics_nm.tolist(),
    }
