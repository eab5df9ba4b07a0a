"""Recordings behind an adaptive optics simulated end to end: per seeing a cube and a focus ramp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simulator.campaign import CALIBRATION, CLEAN_DETECTOR, RAMP_MOVE_S, ramp_behind
from simulator.scene import Scene, draw_ncpa_nm

SEED = 20261123
SEEINGS_ARCSEC = (0.5, 1.0)
OFFSETS_NM = (-300.0, -150.0, 0.0, 150.0, 300.0)


def scenes(seed: int = SEED) -> list[Scene]:
    """Return every scene, the longest first; each seeing has NCPAs of its own, drawn from `seed`."""
    cubes = [_cube(index, seed) for index in range(len(SEEINGS_ARCSEC))]
    ramps = [_step(cube, step) for cube in cubes for step in range(len(OFFSETS_NM))]
    return [*cubes, *ramps]


def _cube(index: int, seed: int) -> Scene:
    seeing = SEEINGS_ARCSEC[index]
    return replace(
        CALIBRATION,
        name=f"seeing_{seeing:.2f}/calibration",
        seed=(seed, index, 0),
        seeing_arcsec=seeing,
        ncpa_nm=draw_ncpa_nm(np.random.default_rng((seed, index))),
        detector=CLEAN_DETECTOR,
        lost_frame=None,
        cosmic=None,
    )


def _step(cube: Scene, index: int) -> Scene:
    return ramp_behind(
        cube,
        600 + RAMP_MOVE_S * index,
        name=f"{cube.name.partition('/')[0]}/ramp/offset_{index:02d}",
        seed=(*cube.seed, 1, index),
        frames=3,
        points_per_band=7,
        introduced_defocus_nm=OFFSETS_NM[index],
    )
