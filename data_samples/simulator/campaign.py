"""The recordings of the data samples: one calibration cube, one defocus ramp, one MUSE raw file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from simulator.detector import Detector
from simulator.scene import Band, Cosmic, Scene, draw_ncpa_nm

SEED = 20240211
NCPA_SEED = (SEED, 5)  # the first draw in which tip and tilt hold no more than their expected share
CALIBRATION_SEED = (SEED, 1)
MUSE_SEED = (SEED, 2)
RAMP_SEED = (SEED, 3)

NARROW_H = (Band(1600.0, 20.0),)
# Three-point Gauss-Legendre nodes of these bands lie at 1170, 1215, 1260 and 1560, 1625, 1690 nm.
BROAD_J_H = (Band(1215.0, 45 / np.sqrt(0.6), 0.5), Band(1625.0, 65 / np.sqrt(0.6), 0.5))
# Width of the narrow band over that of J+H: the photometric zero point holds for J+H.
NARROW_FLUX_FRACTION = 0.14

RAMP_OFFSETS_NM = (-300.0, -200.0, -100.0, 0.0, 100.0, 200.0, 300.0)
# The stage changes its direction of travel before every offset, from the outside inwards.
RAMP_ORDER = (0, 6, 1, 5, 2, 4, 3)
RAMP_MOVE_S = 24

WORN_DETECTOR = Detector(
    e_per_adu=2.0,
    dead=((26, 37),),
    hot_e_per_s=(((12, 50), 20_000.0),),
    hot_after_dark_e_per_s=(((47, 15), 8_000.0),),
)
CLEAN_DETECTOR = Detector(e_per_adu=2.0, pedestal_adu=200.0)

CALIBRATION = Scene(
    name="calibration-sky",
    role="ncpa_calibration",
    target="SIM-CAL",
    seed=CALIBRATION_SEED,
    mag_j=7.0,
    seeing_arcsec=0.5,
    jitter_mas=7.0,
    exposure_s=0.1,
    frames=200,
    subexposures=25,
    bands=NARROW_H,
    points_per_band=5,
    flux_fraction=NARROW_FLUX_FRACTION,
    ncpa_nm=draw_ncpa_nm(np.random.default_rng(NCPA_SEED)),
    diversity_nm={6: -170.0},
    detector=WORN_DETECTOR,
    lost_frame=120,
    cosmic=Cosmic(77, (((18, 45), 30_000.0), ((18, 46), 12_000.0), ((19, 47), 5_000.0))),
)

MUSE = replace(
    CALIBRATION,
    name="MUSE.2024-02-11T03:05:20.000",
    target="SIM-MUSE",
    seed=MUSE_SEED,
    mag_j=9.0,
    frames=40,
    detector=CLEAN_DETECTOR,
    lost_frame=None,
    cosmic=None,
    start_s=1_707_620_720,
)


def ramp_scene(index: int) -> Scene:
    """Return the recording at RAMP_OFFSETS_NM[index]; its start tells its place in the ping-pong order."""
    return ramp_behind(
        CALIBRATION,
        600 + RAMP_ORDER.index(index) * RAMP_MOVE_S,
        name=f"ramp/offset_{index:02d}",
        seed=(*RAMP_SEED, index),
        frames=6,
        points_per_band=11,
        introduced_defocus_nm=RAMP_OFFSETS_NM[index],
    )


def ramp_behind(cube: Scene, delay_s: int, **its: Any) -> Scene:
    """Return a step of a ramp behind the optics of a `cube`, `delay_s` after it, with fields of `its` own."""
    return replace(
        cube,
        role="defocus_ramp",
        target="SIM-RAMP",
        mag_j=12.0,
        exposure_s=1.0,
        subexposures=100,
        bands=BROAD_J_H,
        flux_fraction=1.0,
        lost_frame=None,
        cosmic=None,
        start_s=cube.start_s + delay_s,
        first_counter=cube.first_counter + delay_s * cube.loop_hz,
        **its,
    )


def recorder_scenes() -> list[Scene]:
    """Return the scenes written as recorder folders, the longest first."""
    return [CALIBRATION, *(ramp_scene(index) for index in range(len(RAMP_OFFSETS_NM)))]
