"""NCPAs corrected by a deformable mirror until nothing improves (paper, Sect. 6.1).

A cube of the star is calibrated, the mirror is sent minus the estimate, and the next cube is taken through
what the mirror made of it. The mirror is not the one that its control believes in: its gain is off, and its
actuators are shifted and turned against the pupil. The star was refocused before, or has a defocus bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import CORRECTED_NOLLS, DEFOCUS, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.effects import fixed_optics
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.correction import modal_offsets, predict_correction
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import MIRROR_DIVERSITY_NM, CubeSample, ObservedCube
from irlos_pipe.paper.common.ramps import knowledge_of
from irlos_pipe.paper.common.star import star_image
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE, VARIANTS
from irlos_pipe.paper.mirror_loop.told import Judge, diversity_error_nm, further, told
from irlos_pipe.simulate.exposure import telescope_of
from irlos_pipe.simulate.mirror import Actuators, Mirror
from irlos_pipe.simulate.scene import Scene

CUBE_STREAM = 10  # child of a sample's seed; every further cube has another sky
IMPROVES = 0.9  # an estimate is followed where it is below this part of the one before
FITTED_BY = 6  # corrections after which an aligned mirror leaves what it cannot make
ALIGNED = "none"  # of the errors
SERIES = ("modes_nm", "beyond_nm", "all_nm", "strehl", "seen_nm")
PARTS = ("finer", "fitting", "registration", "diversity", "estimate")


@dataclass(frozen=True)
class Loop:
    """A method of calibration, and how the diversity is made.

    Attributes
    ----------
    method : str
        One of `VARIANTS`.
    diversity : {"exact", "mirror"}
        As declared, or by the same mirror with the same errors.
    """

    method: str
    diversity: Literal["exact", "mirror"]

    @property
    def name(self) -> str:
        """Return what results call it."""
        return f"{self.method}, {self.diversity}"


LOOPS = (Loop(DEFAULT, "exact"), Loop(PAPER_CHOICE, "exact"), Loop(DEFAULT, "mirror"))


@dataclass(frozen=True)
class MirrorErrors:
    """How a mirror differs from the one that its control believes in.

    Attributes
    ----------
    gain : float
        Stroke over the stroke asked for.
    shift : float
        Of the actuators along x, over the diameter of the pupil.
    turn_deg : float
    """

    gain: float = 1.0
    shift: float = 0.0
    turn_deg: float = 0.0

    def alone(self) -> dict[str, MirrorErrors]:
        """Return mirrors with none of the errors, with each, with the gain too high, and with all."""
        return {
            ALIGNED: MirrorErrors(),
            "gain": MirrorErrors(gain=self.gain),
            "opposite gain": MirrorErrors(gain=2 - self.gain),
            "shift": MirrorErrors(shift=self.shift),
            "turn": MirrorErrors(turn_deg=self.turn_deg),
            "all": self,
        }


@dataclass(frozen=True)
class MirrorSample:
    """One set of NCPAs with one bias of the defocus.

    Attributes
    ----------
    bias_nm : float
        Defocus in place of that of the NCPAs; 0 where the star was refocused before [nm RMS].
    frames, star_frames : int
        Of a cube, and of the star's averaged image.
    corrections : int
        At most.
    pitches_m : tuple of float
        From actuator to actuator: of the mirror of the loops first, then of mirrors that are only told the
        truth.
    errors : MirrorErrors
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    bias_nm: float
    frames: int
    star_frames: int
    corrections: int
    seeing_arcsec: float
    mag_j: float
    pitches_m: tuple[float, ...]
    errors: MirrorErrors

    def scene(self) -> Scene:
        """Return the cube before any correction."""
        cube = CubeSample(
            self.name, self.seed, self.facility, self.seeing_arcsec, self.frames, self.mag_j
        ).scene()
        return replace(
            cube,
            ncpa_nm={**cube.ncpa_nm, DEFOCUS: self.bias_nm},
            diversity_nm=MIRROR_DIVERSITY_NM,
            diversity_source="mirror",
            sampling=FINE,
        )

    def mirror(self, pitch_m: float, errors: MirrorErrors) -> Mirror:
        """Return the mirror with actuators `pitch_m` apart and with `errors`, at rest."""
        diameter_m = self.facility.pupil.diameter_m
        actuators = Actuators(diameter_m, pitch_m)
        return Mirror(actuators, errors.gain, (errors.shift * diameter_m, 0.0), errors.turn_deg)


def close(sample: MirrorSample) -> dict[str, Any]:
    """Close every loop of `LOOPS` on a sample, and tell every mirror the truth.

    Returns
    -------
    dict of str to ndarray or float
        ``<loop>/<series>``, (corrections + 1,), NaN after the end: ``modes_nm``, ``beyond_nm``, ``all_nm``,
        the true wavefront left in Noll 4–30, beyond, and altogether; ``strehl`` of the star without
        diversity; ``seen_nm``, RMS of the estimate. ``<loop>/corrections``; ``<loop>/predicted``, the Strehl
        ratio that is predicted of the first correction; ``<loop>/<part>/modes_nm`` and ``…/beyond_nm`` of
        `PARTS`, whose wavefronts add up to the one left. ``alone/<pitch>/<error>/modes_nm`` and
        ``…/beyond_nm``, (corrections + 1,), of mirrors that are told the truth. ``ideal``, Strehl ratio
        without NCPAs.
    """
    bench = _Bench(sample)
    found: dict[str, Any] = {"ideal": star_image(bench.scene, sample.star_frames, {})[1]}
    for loop in LOOPS:
        found |= {f"{loop.name}/{key}": value for key, value in bench.closed(loop).items()}
    for pitch_m in sample.pitches_m:
        for error, errors in sample.errors.alone().items():
            alone = bench.alone(sample.mirror(pitch_m, errors))
            found |= {f"alone/{pitch_m:g}/{error}/{key}": value for key, value in alone.items()}
    return found


class _Bench:
    """The star, the pupil and the mirrors of a sample."""

    def __init__(self, sample: MirrorSample):
        self.sample, self.scene = sample, sample.scene()
        self.judge = Judge(telescope_of(self.scene))
        self.opd_nm = self.judge.telescope.opd_nm(self.scene.ncpa_nm)

    def closed(self, loop: Loop) -> dict[str, Any]:
        """Correct until the estimate falls no more."""
        mirror = self.sample.mirror(self.sample.pitches_m[0], self.sample.errors)
        rows: list[list[float]] = []
        predicted = np.nan
        for index in range(self.sample.corrections + 1):
            cube = ObservedCube.of(self._cube(loop, mirror, index))
            calibration = cube.calibrated(VARIANTS[loop.method])
            seen_nm = seen_by(calibration)
            seen_rms_nm = float(np.linalg.norm([seen_nm[noll] for noll in CORRECTED_NOLLS]))
            rows.append([*self._left(mirror), self._strehl(mirror), seen_rms_nm])
            if index == 0:
                predicted = predicted_strehl(cube, calibration)
            if not improves([row[-1] for row in rows]) or index == self.sample.corrections:
                break
            mirror = replace(mirror, offsets_nm=further(mirror.offsets_nm, seen_nm))
        series = np.full((self.sample.corrections + 1, len(SERIES)), np.nan)
        series[: len(rows)] = rows
        numbers = {"corrections": len(rows) - 1, "predicted": predicted}
        return dict(zip(SERIES, series.T, strict=True)) | numbers | self._parts(loop, mirror, len(rows) - 1)

    def alone(self, mirror: Mirror) -> dict[str, np.ndarray]:
        """Tell a mirror the truth."""
        states = told(self.judge, mirror, self.opd_nm, 0.0, self.sample.corrections)
        left = [self.judge.left(state) for state in states]
        return {
            "modes_nm": np.array([one.modes_nm for one in left]),
            "beyond_nm": np.array([one.beyond_nm for one in left]),
        }

    def _left(self, mirror: Mirror) -> tuple[float, float, float]:
        left = self.judge.left(self.opd_nm + mirror.opd_nm(self.judge.telescope))
        return left.modes_nm, left.beyond_nm, left.all_nm

    def _strehl(self, mirror: Mirror) -> float:
        """Strehl ratio of the star, which the fast loop keeps centred."""
        moved_nm = self.judge.coefficients_nm(mirror.opd_nm(self.judge.telescope))
        ncpa_nm = {**self.scene.ncpa_nm} | {noll: -moved_nm[noll] for noll in TIP_TILT}
        return star_image(replace(self.scene, mirror=mirror), self.sample.star_frames, ncpa_nm)[1]

    def _cube(self, loop: Loop, mirror: Mirror, index: int) -> Scene:
        """Return the cube number `index`, taken through the mirror."""
        scene = replace(self.scene, mirror=mirror, seed=(*self.scene.seed, CUBE_STREAM + index))
        if loop.diversity == "exact":
            return scene
        # The scene adds the diversity as declared; here the mirror makes it, so that it is taken out once.
        declared_nm = scene.diversity_nm
        ncpa_nm = {noll: value - declared_nm.get(noll, 0.0) for noll, value in scene.ncpa_nm.items()}
        sent_nm = {
            noll: mirror.offsets_nm.get(noll, 0.0) + declared_nm.get(noll, 0.0) for noll in CORRECTED_NOLLS
        }
        return replace(scene, ncpa_nm=ncpa_nm, mirror=replace(mirror, offsets_nm=sent_nm))

    def _parts(self, loop: Loop, mirror: Mirror, done: int) -> dict[str, float]:
        """Split what is left after `done` corrections."""
        judge, opd_nm = self.judge, self.opd_nm
        aligned = self.sample.mirror(mirror.actuators.pitch_m, MirrorErrors())
        real = replace(mirror, offsets_nm={})
        unseen_nm: np.ndarray | float = 0.0
        if loop.diversity == "mirror":
            unseen_nm = diversity_error_nm(judge.telescope, real, self.scene.diversity_nm)
        finer_nm = {noll: value for noll, value in self.scene.ncpa_nm.items() if noll > CORRECTED_NOLLS[-1]}
        states = (
            judge.telescope.opd_nm(finer_nm),
            told(judge, aligned, opd_nm, 0.0, FITTED_BY)[-1],
            told(judge, real, opd_nm, 0.0, done)[-1],
            told(judge, real, opd_nm, unseen_nm, done)[-1],
            opd_nm + mirror.opd_nm(judge.telescope),
        )
        found: dict[str, float] = {}
        before_nm = np.zeros_like(opd_nm)
        for part, state_nm in zip(PARTS, states, strict=True):
            left = judge.left(state_nm - before_nm)
            found |= {f"{part}/modes_nm": left.modes_nm, f"{part}/beyond_nm": left.beyond_nm}
            before_nm = state_nm
        return found


def improves(seen_nm: Sequence[float]) -> bool:
    """Return whether the last of the estimates `seen_nm`, NaN after the end, is well below the one before."""
    there = [one for one in seen_nm if np.isfinite(one)]
    return len(there) < 2 or bool(there[-1] < IMPROVES * there[-2])


def seen_by(calibration: Calibration) -> dict[int, float]:
    """Return minus the offsets that the stage `correct` makes of a `calibration`, Noll: nm RMS."""
    offsets = modal_offsets(calibration.nolls, calibration.zernike_nm, calibration.sigma_nm, 1.0)
    return dict(zip(offsets.nolls.tolist(), (-offsets.value_nm).tolist(), strict=True))


def predicted_strehl(cube: ObservedCube, calibration: Calibration) -> float:
    """Return the Strehl ratio that the stage `correct` predicts of the star after a full correction.

    Parameters
    ----------
    cube : ObservedCube
    calibration : Calibration
    """
    nolls = calibration.nolls
    effects = list(knowledge_of(cube, calibration).effects.values())
    gain = np.isin(nolls, REPORTED_NOLLS).astype(float)
    return predict_correction(
        cube.settings,
        nolls,
        calibration.fitted_modes_nm,
        calibration.zernike_nm,
        gain,
        lambda model: fixed_optics(effects, model.grids),
    ).strehl_after
