"""Calibration methods against the length of an exposure, with the same light (paper, Sect. 5.1).

Frames of the shortest exposure follow one another without a gap; longer ones are their sums before the noise.
So all cubes of a sample show the same star and AO residual for the same time, each with its own noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.observation import frames_of
from irlos_pipe.paper.common.variants import VARIANTS
from irlos_pipe.simulate.scene import Scene


@dataclass(frozen=True)
class ExposuresSample:
    """One star, and the exposures it is taken with.

    Attributes
    ----------
    cube : CubeSample
        Its frames are those of the shortest exposure.
    shortest_s : float
    sums : tuple of int
        How many of the shortest exposures every longer one is the sum of.
    methods : tuple of str
        Keys of `VARIANTS`.
    """

    cube: CubeSample
    shortest_s: float
    sums: tuple[int, ...]
    methods: tuple[str, ...]

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name

    def scene(self) -> Scene:
        """Return the recording with the shortest exposures."""
        return replace(self.cube.scene(), exposure_s=self.shortest_s, frame_rate_hz=1 / self.shortest_s)


def compare(sample: ExposuresSample) -> dict[str, float]:
    """Calibrate every sum of the exposures of a sample by every method.

    Returns
    -------
    dict of str to float
        ``<sum>/<method>/modes_nm``, Δ-WFE in Noll 2–30 against the mean wavefront of all frames.
    """
    scene = sample.scene()
    shortest = ObservedCube.of(scene)
    found: dict[str, float] = {}
    for count in sample.sums:
        cube = summed(shortest, count)
        for method in sample.methods:
            found[f"{count}/{method}/modes_nm"] = cube.modes_delta_nm(cube.calibrated(VARIANTS[method]))
    return found


def summed(cube: ObservedCube, count: int) -> ObservedCube:
    """Return a cube whose exposures are each the sum of `count` of those of another, with noise of its own.

    Frames that do not fill an exposure are left out.
    """
    if count == 1:
        return cube
    frames = cube.scene.frames // count
    used = frames * count
    mean_e = cube.exposed.mean_e[:used]
    exposed = replace(
        cube.exposed,
        mean_e=mean_e.reshape(frames, count, *mean_e.shape[1:]).sum(axis=1),
        zernike_nm=cube.exposed.zernike_nm[:used].reshape(frames, count, -1).mean(axis=1),
    )
    exposure_s = cube.scene.exposure_s * count
    scene = replace(
        cube.scene,
        frames=frames,
        exposure_s=exposure_s,
        frame_rate_hz=1 / exposure_s,
        seed=(*cube.scene.seed, count),
    )
    return ObservedCube(scene, exposed, frames_of(scene, exposed))
