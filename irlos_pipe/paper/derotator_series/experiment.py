"""The derotator test (paper, Sect. 6.1) with known truth: cubes at several angles of the derotator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import REPORTED_NOLLS, TIP_TILT
from irlos_pipe.estimate.derotator import Series, Split
from irlos_pipe.optics.rotation import partner, rotation_matrix
from irlos_pipe.paper.common.cube import MIRROR_DIVERSITY_NM, NARROW_H, NARROW_THROUGHPUT, ObservedCube
from irlos_pipe.paper.common.phase_bump import phase_bump_nm
from irlos_pipe.paper.common.variants import VARIANTS
from irlos_pipe.paper.derotator_series.results import SplitErrors
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene


@dataclass(frozen=True)
class Truth:
    """The static wavefront, Noll: nm RMS.

    Attributes
    ----------
    rotating_nm : mapping of int to float
        Before the derotator, at angle 0: random NCPAs and the phase bump.
    fixed_nm : mapping of int to float
        Behind it: random NCPAs.
    """

    rotating_nm: Mapping[int, float]
    fixed_nm: Mapping[int, float]

    def at(self, nolls: Sequence[int], angle_deg: float) -> np.ndarray:
        """Return the coefficients of the modes `nolls` at derotator angle `angle_deg`, (modes,) [nm]."""
        every = sorted({other for noll in (*nolls, *self.rotating_nm) for other in (noll, partner(noll))})
        turned = rotation_matrix(every, angle_deg) @ _values(self.rotating_nm, every)
        return _values(dict(zip(every, turned, strict=True)), nolls) + _values(self.fixed_nm, nolls)


def draw_truth(seed: Sequence[int], law: NcpaLaw, rotating_nm: float, fixed_nm: float) -> Truth:
    """Draw random NCPAs on either side of the derotator and add the phase bump before it.

    Parameters
    ----------
    seed : sequence of int
    law : NcpaLaw
    rotating_nm, fixed_nm : float
        RMS of the NCPAs before and behind the derotator [nm].
    """
    rng = np.random.default_rng(seed)
    before, behind = (draw_ncpa_nm(rng, law, total_nm) for total_nm in (rotating_nm, fixed_nm))
    bump = phase_bump_nm()
    together = {noll: before.get(noll, 0.0) + bump.get(noll, 0.0) for noll in sorted({*before, *bump})}
    return Truth(together, behind)


def rms_beyond_tilt_nm(zernike_nm: Mapping[int, float]) -> float:
    """Return the RMS over the disc without tip and tilt [nm]."""
    return float(np.sqrt(sum(value**2 for noll, value in zernike_nm.items() if noll not in TIP_TILT)))


@dataclass(frozen=True)
class AngleSample:
    """The cube of one angle.

    Attributes
    ----------
    frames : mapping of str to int
        Frames that a method, a key of `VARIANTS`, is given; the largest number is simulated.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    truth: Truth
    angle_deg: float
    frames: Mapping[str, int]
    seeing_arcsec: float
    mag_j: float

    def scene(self) -> Scene:
        """Return the recording: narrow H band, 0.1 s at 10 Hz, diversity by the deformable mirror."""
        return Scene(
            self.name,
            self.facility,
            NARROW_H,
            self.seed,
            max(self.frames.values()),
            0.1,
            role="derotator",
            mag_j=self.mag_j,
            throughput=NARROW_THROUGHPUT,
            ncpa_nm=self.truth.fixed_nm,
            rotating_nm=self.truth.rotating_nm,
            derotator_angle_deg=self.angle_deg,
            diversity_nm=MIRROR_DIVERSITY_NM,
            diversity_source="mirror",
            sky=Sky(self.seeing_arcsec),
            motion=Motion(),
        )


def estimate(sample: AngleSample) -> dict[str, np.ndarray]:
    """Simulate one cube and calibrate it by every method.

    Returns
    -------
    dict of str to ndarray
        ``mean_image_e``, and for every method ``<method>/noll``, ``/zernike_nm``, ``/covariance_nm2``,
        ``/chi2_nu`` and ``/delta_nm``, the Δ-WFE in Noll 2–30 against the mean wavefront of its frames.
    """
    cube = ObservedCube.of(sample.scene())
    numbers = {"mean_image_e": cube.frames.mean_e.numpy()}
    for method, count in sample.frames.items():
        own = cube.first(count)
        calibration = own.calibrated(VARIANTS[method].closed())
        numbers |= {
            f"{method}/noll": np.array(calibration.nolls),
            f"{method}/zernike_nm": calibration.zernike_nm,
            f"{method}/covariance_nm2": calibration.covariance_nm2,
            f"{method}/chi2_nu": np.array(calibration.chi2_nu),
            f"{method}/delta_nm": np.array(own.modes_delta_nm(calibration)),
        }
    return numbers


def split_errors(series: Series, split: Split, truth: Truth) -> SplitErrors:
    """Compare the `split` of the estimates `series` with the simulated `truth`."""
    reported = np.isin(split.nolls, REPORTED_NOLLS)
    apart, sums = reported & split.separable, reported & ~split.separable
    rotating, fixed = (_values(part, split.nolls) for part in (truth.rotating_nm, truth.fixed_nm))
    static = np.array([truth.at(split.nolls, angle) for angle in series.angles_deg])
    wrong = {
        "rotating_nm": (split.rotating.zernike_nm - rotating)[apart],
        "fixed_nm": (split.fixed.zernike_nm - fixed)[apart],
        "unsplit_nm": (split.unsplit.zernike_nm - rotating - fixed)[sums],
        "rotating_all_nm": _whole(split, truth),
    }
    return SplitErrors(
        **{name: float(np.linalg.norm(values)) for name, values in wrong.items()},
        single_nm=_mean_norm((series.zernike_nm - static)[:, reported]),
        model_nm=_mean_norm((split.predicted_nm - static)[:, reported]),
    )


def _whole(split: Split, truth: Truth) -> np.ndarray:
    """Error of the rotating part in all modes that turn."""
    found = dict(zip(split.nolls, split.rotating.zernike_nm, strict=True))
    turning = [noll for noll in truth.rotating_nm if partner(noll) != noll and noll not in TIP_TILT]
    return _values(found, turning) - _values(truth.rotating_nm, turning)


def _mean_norm(values: np.ndarray) -> float:
    """RMS over the rows of their norms."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def _values(given_nm: Mapping[int, float], nolls: Sequence[int]) -> np.ndarray:
    return np.array([given_nm.get(noll, 0.0) for noll in nolls])
