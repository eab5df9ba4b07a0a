"""Whether quoted errors hold: pulls of calibrations and ramps over many simulated cubes.

Of each a calibration cube is simulated, and a ramp of a fainter star behind the same optics. Quoted errors
hold where the RMS of error over quoted error is one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, get_args

import click
import numpy as np

from benchmarks import harness
from benchmarks.harness import Outcome, Suite, markdown
from irlos_pipe.conventions.modes import DEFOCUS, HIGHEST_REPORTED_NOLL
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.lift import FrameErrors, instant_error_nm, nominal_frame_chi2, optics_sigma_nm
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper.common.calibrations import DEFAULT, VARIANTS, ObservedCube
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, knowledge_of, observe, ramp_scene
from irlos_pipe.paper.common.scenes import COARSE, cube_scene
from irlos_pipe.simulate.atmosphere import Shape
from irlos_pipe.simulate.scene import Scene

REPORTED_SEED = 17724539  # of the reported run; by 14142135 the instant's error was defined
SEEINGS_ARCSEC = (0.35, 0.5, 0.7, 1.0)
SHAPES: tuple[Shape, ...] = get_args(Shape)
MAG_J, RAMP_MAG_J = 7.0, 12.0
OFFSETS_NM, FRAMES_PER_OFFSET = (-200.0, -100.0, 0.0, 100.0, 200.0), 3
NOLLS = range(4, HIGHEST_REPORTED_NOLL + 1)  # tip and tilt are the star's place, not an aberration
DRAWS, BOOTSTRAP_SEED = 2000, 1  # resamples of the pulls for confidence intervals
HEAD = (
    "cubes",
    "",
    "error",
    "quoted",
    "pull",
    "χ² of the covariance",
    "pull of a ramp",
    "of its mean",
)


@dataclass(frozen=True)
class Case:
    """One cube and its ramp; what is drawn follows from `seed` and `index`."""

    seed: int
    index: int
    frames: int

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.index:04d}"

    @property
    def key(self) -> tuple:
        """What its outcome must say of it."""
        return self.seed, self.frames

    @property
    def seeing_arcsec(self) -> float:
        """All of them in turn."""
        return SEEINGS_ARCSEC[self.index % len(SEEINGS_ARCSEC)]

    @property
    def shape(self) -> Shape:
        """Of the residual: all of them in turn."""
        return SHAPES[self.index // len(SEEINGS_ARCSEC) % len(SHAPES)]

    def scene(self) -> Scene:
        """Return the cube."""
        facility = load_instrument("irlos").facility
        seed = self.seed, self.index
        return cube_scene(self.name, seed, facility, self.seeing_arcsec, self.frames, MAG_J, self.shape)


def outcome_of(case: Case, *_) -> Outcome:
    """Simulate and estimate a `case`; return errors next to the quoted ones."""
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


def _of_cube(cube: ObservedCube, calibration: Calibration) -> dict[str, Any]:
    """Errors of Noll 4–30 against the static NCPAs, and against the mean wavefront of the frames."""
    own = [calibration.nolls.index(noll) for noll in NOLLS]
    found_nm, mean_nm = calibration.zernike_nm[own], cube.exposed.mean_zernike_nm()
    covariance = calibration.covariance_nm2[np.ix_(own, own)]
    error_nm = found_nm - np.array([cube.scene.ncpa_nm.get(noll, 0.0) for noll in NOLLS])
    return {
        "error_nm": error_nm.tolist(),
        "error_of_mean_nm": (found_nm - np.array([mean_nm[noll] for noll in NOLLS])).tolist(),
        "sigma_nm": np.sqrt(np.diag(covariance)).tolist(),
        "chi2": float(error_nm @ np.linalg.solve(covariance, error_nm)),
        "misfit": calibration.chi2_nu / calibration.nominal.value,
        "errors_from": calibration.errors_from,
    }


def _of_ramp(cube: ObservedCube, calibration: Calibration) -> dict[str, Any]:
    """Errors of the defocus of every frame, and the parts of what is quoted for it."""
    offsets_nm = np.repeat(OFFSETS_NM, FRAMES_PER_OFFSET)
    changes = {"sampling": COARSE, "sky": cube.scene.sky}
    scene = ramp_scene(cube.scene, RAMP_MAG_J, offsets_nm.tolist(), **changes)
    observed = observe(scene, {DEFAULT: knowledge_of(cube, calibration)})
    fit, data = observed.estimate(LIFT_VARIANTS["default_3"]), observed.data
    photon_nm = fit.result.mode(DEFOCUS)[1].numpy()
    fitted = fit.result.solution.values.shape[1]
    nominal = nominal_frame_chi2(data.images_e, fit.result.model_e, data.good, data.noise, offsets_nm, fitted)
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


# -- the table ---------------------------------------------------------------------------------


def table(outcomes: Sequence[Outcome], *_) -> str:
    """Return the pulls of `outcomes`, by seeing, by shape of the residual, and of all."""
    groups: list[tuple[str, Callable[[Outcome], bool]]] = [
        *((f"{seeing:g}″", lambda one, s=seeing: one["seeing_arcsec"] == s) for seeing in SEEINGS_ARCSEC),
        *((shape.replace("_", " "), lambda one, s=shape: one["shape"] == s) for shape in SHAPES),
        ("**all**", lambda one: True),
    ]
    rows = ((name, [one for one in outcomes if belongs(one)]) for name, belongs in groups)
    return markdown(HEAD, [_row(name, some) for name, some in rows if some])


def _row(name: str, some: Sequence[Outcome]) -> list[str]:
    cubes, ramps = [one["cube"] for one in some], [one["ramp"] for one in some]
    chi2 = np.mean([one["chi2"] / len(one["error_nm"]) for one in cubes])
    return [
        str(len(some)),
        name,
        *(f"{_total(cubes, key):.1f} nm" for key in ("error_nm", "sigma_nm")),
        _with_interval(cubes),
        f"{chi2:.2f}",
        _with_interval(ramps),
        f"{np.sqrt(np.mean([_optics_pull(one) ** 2 for one in ramps])):.2f}",
    ]


def _optics_pull(ramp: Outcome) -> float:
    """Mean error of the frames of a ramp, which the optics share, over what is quoted for it."""
    error = np.array(ramp["error_nm"])
    own = np.hypot(ramp["instant_nm"], np.array(ramp["photon_nm"])) / np.sqrt(len(error))
    return float(error.mean() / np.sqrt(np.mean(np.array(ramp["optics_nm"]) ** 2 + own**2)))


def _total(cubes: Sequence[Outcome], key: str) -> float:
    """RMS over the cubes of the sum in quadrature over their modes."""
    return float(np.sqrt(np.mean([np.sum(np.square(one[key])) for one in cubes])))


def _with_interval(some: Sequence[Outcome]) -> str:
    """RMS pull, with the interval of 90 % over draws of the cases."""
    squares = np.array([np.nanmean((np.array(o["error_nm"]) / np.array(o["sigma_nm"])) ** 2) for o in some])
    drawn = np.random.default_rng(BOOTSTRAP_SEED).integers(0, len(squares), (DRAWS, len(squares)))
    low, high = np.percentile(np.sqrt(squares[drawn].mean(axis=1)), [5, 95])
    return f"{np.sqrt(squares.mean()):.2f} ({low:.2f}–{high:.2f})"


SUITE = Suite(outcome_of, itemgetter("seed", "frames"), table, "performance.md", "pulls")


@click.command()
@harness.options(REPORTED_SEED)
@click.option("--cubes", default=200, show_default=True, help="Number of cubes, each with a ramp.")
@click.option("--frames", default=200, show_default=True, help="Of every cube, 0.1 s each.")
def main(cubes: int, frames: int, seed: int, **how) -> None:
    """Simulate calibrations and ramps, and compare their errors with those quoted."""
    harness.run(SUITE, [Case(seed, index, frames) for index in range(cubes)], **how)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.pulls")
