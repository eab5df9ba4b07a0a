"""A star behind a deformable mirror that differs from the one its control believes in, and what it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, HIGHEST_REPORTED_NOLL, TIP_TILT
from irlos_pipe.paper.common.calibrations import weighted_rms
from irlos_pipe.paper.common.scenes import star_image
from irlos_pipe.simulate.exposure import telescope_of
from irlos_pipe.simulate.mirror import Actuators, Mirror
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope

CUBE_STREAM = 10  # child of a sample's seed; every further cube has another sky
FITTED_BY = 6  # corrections after which an aligned mirror leaves what it cannot make
# Highest Noll mode of the fit, so that modes beyond the corrected ones do not leak into them.
LAST_FITTED = 66
# How the diversity is made: as declared, or by the same mirror with the same errors.
EXACT, BY_MIRROR = "exact", "mirror"
LEFT = ("modes_nm", "beyond_nm", "all_nm")  # residual in Noll 4–30, beyond these modes, and in all


@dataclass(frozen=True)
class MirrorErrors:
    """How a mirror differs from the one that its control believes in: stroke, shift over the pupil, turn."""

    gain: float = 1.0
    shift: float = 0.0
    turn_deg: float = 0.0

    def alone(self) -> dict[str, MirrorErrors]:
        """Return mirrors with none of the errors, with each, with the gain too high, and with all."""
        return {
            "none": MirrorErrors(),
            "gain": MirrorErrors(gain=self.gain),
            "opposite gain": MirrorErrors(gain=2 - self.gain),
            "shift": MirrorErrors(shift=self.shift),
            "turn": MirrorErrors(turn_deg=self.turn_deg),
            "all": self,
        }

    def mirror(self, diameter_m: float, pitch_m: float) -> Mirror:
        """Return the mirror with actuators `pitch_m` apart on a pupil of `diameter_m`, at rest."""
        return Mirror(
            Actuators(diameter_m, pitch_m), self.gain, (self.shift * diameter_m, 0.0), self.turn_deg
        )


class Bench:
    """A star, its wavefront on the pupil of the simulator, and what mirrors leave of it."""

    def __init__(self, scene: Scene, star_frames: int):
        self.scene, self.star_frames = scene, star_frames
        self.telescope: Telescope = telescope_of(scene)
        self.opd_nm = self.telescope.opd_nm(scene.ncpa_nm)

    def cube(self, mirror: Mirror, index: int, diversity: str) -> Scene:
        """Return the cube number `index`, taken through the mirror."""
        scene = replace(self.scene, mirror=mirror, seed=(*self.scene.seed, CUBE_STREAM + index))
        if diversity == EXACT:
            return scene
        # The scene adds the diversity as declared; here the mirror makes it, so that it is taken out once.
        declared_nm = scene.diversity_nm
        ncpa_nm = {noll: value - declared_nm.get(noll, 0.0) for noll, value in scene.ncpa_nm.items()}
        sent_nm = {
            noll: mirror.offsets_nm.get(noll, 0.0) + declared_nm.get(noll, 0.0) for noll in CORRECTED_NOLLS
        }
        return replace(scene, ncpa_nm=ncpa_nm, mirror=replace(mirror, offsets_nm=sent_nm))

    def coefficients_nm(self, opd_nm: np.ndarray) -> dict[int, float]:
        """Return Noll 2..30 of a wavefront `opd_nm`, (n, n), fitted jointly with modes beyond [nm RMS]."""
        fitted_nm = self.telescope.fit_zernike_nm(opd_nm, LAST_FITTED)[: HIGHEST_REPORTED_NOLL - 1]
        return dict(enumerate(fitted_nm.tolist(), start=2))

    def of(self, opd_nm: np.ndarray) -> dict[str, float]:
        """Return the RMS of parts of a wavefront, see `LEFT`, without tip and tilt."""
        found_nm = self.coefficients_nm(opd_nm)
        modes_nm = self.telescope.opd_nm({noll: found_nm[noll] for noll in CORRECTED_NOLLS})
        still_nm = opd_nm - self.telescope.opd_nm({noll: found_nm[noll] for noll in TIP_TILT})
        parts = modes_nm, still_nm - modes_nm, still_nm
        return {
            name: weighted_rms(part, self.telescope.transmission)
            for name, part in zip(LEFT, parts, strict=True)
        }

    def left(self, mirror: Mirror) -> dict[str, float]:
        """Return what a mirror leaves of the wavefront."""
        return self.of(self.opd_nm + mirror.opd_nm(self.telescope))

    def strehl(self, mirror: Mirror) -> float:
        """Return the Strehl ratio of the star, which the fast loop keeps centred."""
        moved_nm = self.coefficients_nm(mirror.opd_nm(self.telescope))
        ncpa_nm = {**self.scene.ncpa_nm} | {noll: -moved_nm[noll] for noll in TIP_TILT}
        return star_image(replace(self.scene, mirror=mirror), self.star_frames, ncpa_nm)[1]

    def told(self, mirror: Mirror, unseen_nm: np.ndarray | float, corrections: int) -> list[np.ndarray]:
        """Return the wavefronts that a mirror leaves when every estimate is the truth, before and after each.

        `unseen_nm` is in the cubes that the estimates are made of, but not in the wavefront: the error of the
        diversity.
        """
        states = [self.opd_nm + mirror.opd_nm(self.telescope)]
        for _ in range(corrections):
            offsets_nm = further(mirror.offsets_nm, self.coefficients_nm(states[-1] + unseen_nm))
            mirror = replace(mirror, offsets_nm=offsets_nm)
            states.append(self.opd_nm + mirror.opd_nm(self.telescope))
        return states

    def causes(self, mirror: Mirror, done: int, diversity: str) -> dict[str, dict[str, float]]:
        """Split what is left after `done` corrections by its causes, whose wavefronts add up to it."""
        aligned = MirrorErrors().mirror(mirror.actuators.diameter_m, mirror.actuators.pitch_m)
        real = replace(mirror, offsets_nm={})
        unseen_nm: np.ndarray | float = 0.0
        if diversity == BY_MIRROR:
            unseen_nm = diversity_error_nm(self.telescope, real, self.scene.diversity_nm)
        finer_nm = {noll: value for noll, value in self.scene.ncpa_nm.items() if noll > CORRECTED_NOLLS[-1]}
        states = {
            "finer": self.telescope.opd_nm(finer_nm),
            "fitting": self.told(aligned, 0.0, FITTED_BY)[-1],
            "registration": self.told(real, 0.0, done)[-1],
            "diversity": self.told(real, unseen_nm, done)[-1],
            "estimate": self.opd_nm + mirror.opd_nm(self.telescope),
        }
        parts = np.diff([np.zeros_like(self.opd_nm), *states.values()], axis=0)
        return {cause: self.of(part) for cause, part in zip(states, parts, strict=True)}


def further(offsets_nm: Mapping[int, float], seen_nm: Mapping[int, float]) -> dict[int, float]:
    """Return the offsets of Noll 4..30 after one more estimate; tip and tilt stay."""
    return {noll: offsets_nm.get(noll, 0.0) - seen_nm.get(noll, 0.0) for noll in CORRECTED_NOLLS}


def diversity_error_nm(telescope: Telescope, mirror: Mirror, diversity_nm: Mapping[int, float]) -> np.ndarray:
    """Return by how much the diversity that a `mirror` makes differs from the one declared, (n, n) [nm]."""
    made_nm = replace(mirror, offsets_nm=diversity_nm).opd_nm(telescope)
    return made_nm - telescope.opd_nm(diversity_nm)
