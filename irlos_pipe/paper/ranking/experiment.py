"""All calibration methods on the same cubes, with the same modes and the same frames (paper, Sect. 5).

Published methods have 29 modes and the default an open basis; here every method has every number of modes.
Starts are those of the stage `calibrate`: none knows more than the diversity. The default has the law that
the NCPAs are drawn from as prior, which makes no difference at m_J 7 (`methods`, without prior).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.estimate.calibration_options import OPEN, HighestNoll
from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, VARIANTS, Variant
from irlos_pipe.simulate.ncpa import draw_tail_nm
from irlos_pipe.simulate.scene import Scene

TAIL_STREAM = 3  # child of the cube's seed that the tail is drawn from
LAST_TAIL_NOLL = 200


@dataclass(frozen=True)
class RankingSample:
    """One cube and how its methods are set.

    Attributes
    ----------
    tail_nm : float
        RMS of every mode from behind the last of the law's NCPAs to Noll 200 [nm].
    highest_nolls : tuple of int
        Last modes of all methods; the default's open basis is added.
    parts : tuple of int
        Numbers of frames with which the methods are tried as published.
    """

    cube: CubeSample
    tail_nm: float
    highest_nolls: tuple[int, ...]
    parts: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name

    def scene(self) -> Scene:
        """Return the recording."""
        scene = self.cube.scene()
        if not self.tail_nm:
            return scene
        rng = np.random.default_rng((*self.cube.seed, TAIL_STREAM))
        tail_nm = draw_tail_nm(rng, self.tail_nm, max(scene.ncpa_nm) + 1, LAST_TAIL_NOLL)
        return replace(scene, ncpa_nm={**scene.ncpa_nm, **tail_nm})


def rank(sample: RankingSample) -> dict[str, float]:
    """Simulate a cube and calibrate it by every method.

    Returns
    -------
    dict of str to float
        ``<method>/<highest Noll>``, RMS error of Noll 2–30 against the average over the cube [nm];
        ``<method>/first_<frames>``, the same of its first frames, with the method's own modes and against
        the average of these.
    """
    cube = ObservedCube.of(sample.scene())
    found: dict[str, float] = {}
    for method in METHOD_NAMES:
        for last in highest_nolls(method, sample.highest_nolls):
            found[f"{method}/{last}"] = cube.modes_delta_nm(cube.calibrated(with_modes(method, last)))
        for count in sample.parts:
            fewer = cube.first(count)
            calibration = fewer.calibrated(VARIANTS[method])
            found[f"{method}/first_{count}"] = fewer.modes_delta_nm(calibration)
    return found


def highest_nolls(method: str, asked: tuple[int, ...]) -> tuple[HighestNoll, ...]:
    """Return the last modes that a method is given: those `asked`, and the default its open basis as well."""
    return (*asked, OPEN) if method == DEFAULT else asked


def with_modes(method: str, highest_noll: HighestNoll) -> Variant:
    """Return a method with another number of modes.

    Parameters
    ----------
    method : str
        Key of `METHOD_NAMES`.
    highest_noll : int or "open"
    """
    variant = VARIANTS[method]
    return replace(variant, options=replace(variant.options, highest_noll=highest_noll))
