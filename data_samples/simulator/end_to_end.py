"""Recordings behind an adaptive optics simulated end to end: per seeing a cube and a focus ramp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simulator.campaign import BROAD_J_H, CALIBRATION, CLEAN_DETECTOR
from simulator.scene import Scene, draw_ncpa_nm

SEED = 20261123
SEEINGS_ARCSEC = (0.5, 1.0)
OFFSETS_NM = (-300.0, -150.0, 0.0, 150.0, 300.0)


def scenes() -> list[Scene]:
    """Return every scene, the longest first; each seeing has NCPAs of its own."""
    cubes = [_cube(index) for index in range(len(SEEINGS_ARCSEC))]
    ramps = [_step(cube, step) for cube in cubes for step in range(len(OFFSETS_NM))]
    return [*cubes, *ramps]


def _cube(index: int) -> Scene:
    seeing = SEEINGS_ARCSEC[index]
    return replace(
        CALIBRATION,
        name=f"seeing_{seeing:.2f}/calibration",
        seed=(SEED, index, 0),
        seeing_arcsec=seeing,
        ncpa_nm=draw_ncpa_nm(np.random.default_rng((SEED, index))),
        detector=CLEAN_DETECTOR,
        lost_frame=None,
        cosmic=None,
    )


def _step(cube: Scene, index: int) -> Scene:
    delay_s = 600 + 24 * index
    return replace(
        cube,
        name=f"{cube.name.partition('/')[0]}/ramp/offset_{index:02d}",
        role="defocus_ramp",
        target="SIM-RAMP",
        seed=(*cube.seed, 1, index),
        mag_j=12.0,
        exposure_s=1.0,
        frames=3,
        subexposures=100,
        bands=BROAD_J_H,
        points_per_band=7,
        flux_fraction=1.0,
        introduced_defocus_nm=OFFSETS_NM[index],
        start_s=cube.start_s + delay_s,
        first_counter=cube.first_counter + delay_s * cube.loop_hz,
    )
