"""Recordings of a case: simulated, spoilt as the case says, and written with what is told of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits

from benchmarks.misled.cases import RAMP, SKY, Case
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.readout import electrons
from irlos_pipe.simulate.scene import Sampling, Scene

FACILITY = load_instrument("irlos").facility
TOTAL_NM, MODES_AS = 142.0, "Noll 2 to 51"
THROUGHPUT = 0.047  # of the narrow band, relative to J and H
DIVERSITY_NM = -170.0
GAIN_E, PEDESTAL_ADU = 0.5, 200.0
OFFSETS_NM = (-200.0, -100.0, 0.0, 100.0, 200.0)
PER_OFFSET = 4
USUAL = {
    "frames": 40,
    "mag_j": 7.5,
    "exposure_s": 0.1,
    "window": (40, 40),
    "seeing_arcsec": 0.6,
    "shape": "power_law",
}
SMALL_PX = 24


@dataclass(frozen=True)
class Made:
    """Folders of the recordings by the recipe's input, and what is true.

    Attributes
    ----------
    ncpa_nm : dict of int to float
        Static modes of the calibration, Noll: nm RMS.
    introduced_nm : tuple of float
        True defocus of the frames of the ramp in order.
    """

    inputs: dict[str, list[Path]]
    ncpa_nm: dict[int, float]
    introduced_nm: tuple[float, ...] = ()


def make_case(case: Case, folder: Path) -> Made:
    """Write the recordings of a `case` into a `folder`, which must exist."""
    ncpa_nm = draw_ncpa_nm(np.random.default_rng(case.seed), FACILITY.ncpa_law, TOTAL_NM)
    if case.kind != RAMP:
        cube = _written(folder / "cube", _images(case, ncpa_nm, case.usual, case.hidden, 0), case, case.usual)
        return Made({"calibration": [cube], "cube": [cube]}, ncpa_nm)
    other = np.random.default_rng(case.seed + 1)
    foreign = case.family == "calibration of another instrument"
    calibrated_nm = draw_ncpa_nm(other, FACILITY.ncpa_law, TOTAL_NM) if foreign else ncpa_nm
    both = case.told if case.told.get("both") else {}
    cube = _written(folder / "cube", _images(case, calibrated_nm, {}, {}, 0, spoil=False), case, {}, both)
    ramp = []
    for index, offset_nm in enumerate(OFFSETS_NM):
        usual = {"frames": PER_OFFSET, "mag_j": 9.0, "exposure_s": 0.5}
        images = _images(case, ncpa_nm, usual, case.hidden, 1 + index, offset_nm)
        told = dict(case.told) | {"introduced": offset_nm, "role": "defocus_ramp"}
        ramp.append(_written(folder / f"offset_{index}", images, case, usual, told))
    introduced = tuple(np.repeat(OFFSETS_NM, PER_OFFSET).tolist())
    return Made({"calibration": [cube], "ramp": ramp}, ncpa_nm, introduced)


def _scene(case: Case, ncpa_nm, usual: dict[str, Any], hidden: dict, stream: int, offset_nm: float) -> Scene:
    of = USUAL | usual
    sky = case.setting == SKY
    return Scene(
        "misled",
        FACILITY,
        (Band.of(NARROW_H),),
        (case.seed, stream),
        of["frames"],
        of["exposure_s"],
        mag_j=of["mag_j"],
        throughput=THROUGHPUT,
        frame_rate_hz=1 / of["exposure_s"],
        window=of["window"],
        ncpa_nm=ncpa_nm,
        diversity_nm={6: DIVERSITY_NM},
        introduced_nm=offset_nm,
        sky=Sky(of["seeing_arcsec"], shape=of["shape"]) if sky else None,
        motion=Motion(7.0) if sky else None,
        effects=hidden,
        detector=DetectorModel(e_per_adu=GAIN_E),
        sampling=Sampling(points_per_band=2, step_s=0.03),
    )


def _images(
    case: Case,
    ncpa_nm,
    usual: dict[str, Any],
    hidden: dict,
    stream: int,
    offset_nm: float = 0.0,
    *,
    spoil: bool = True,
) -> np.ndarray:
    """Frames in electrons, (frames, rows, columns)."""
    scene = _scene(case, ncpa_nm, usual, hidden, stream, offset_nm)
    images = electrons(scene, expose(scene).mean_e, np.random.default_rng([case.seed, stream, 7]))
    return _spoilt(case, images, ncpa_nm) if spoil and case.seen else images


def _spoilt(case: Case, images: np.ndarray, ncpa_nm) -> np.ndarray:
    """What is wrong with the images themselves."""
    rows, columns = images.shape[1:]
    if case.seen == "half of another star":
        other = _images(case, {noll: -nm for noll, nm in ncpa_nm.items()}, case.usual, {}, 9, spoil=False)
        return np.concatenate([images[::2], other[1::2]])
    if case.seen == "core clipped":
        return np.minimum(images, 0.5 * images.mean(0).max())
    top, left = (rows - SMALL_PX) // 2, (columns - SMALL_PX) // 2
    return {
        "flipped left to right": lambda: images[:, :, ::-1],
        "flipped up and down": lambda: images[:, ::-1],
        "turned by 180°": lambda: images[:, ::-1, ::-1],
        "transposed": lambda: images.transpose(0, 2, 1),
        "window of 5 λ/D": lambda: images[:, top : top + SMALL_PX, left : left + SMALL_PX],
        "three frames": lambda: images[:3],
        "frames twice": lambda: np.concatenate([images, images]),
    }[case.seen]()


def _written(
    folder: Path, images: np.ndarray, case: Case, usual: dict, told: dict[str, Any] | None = None
) -> Path:
    """Write a FITS cube and its side-car; returns the folder."""
    folder.mkdir()
    adu = np.clip(np.rint(images / GAIN_E + PEDESTAL_ADU), 0, 65535).astype(np.uint16)
    fits.PrimaryHDU(adu).writeto(folder / f"{folder.name}.fits")
    keys = _sidecar(USUAL | usual, case.told if told is None else told, case.setting == SKY)
    (folder / "acquisition.yaml").write_text(yaml.safe_dump(keys))
    return folder


def _sidecar(of: dict[str, Any], told: dict[str, Any], sky: bool) -> dict[str, Any]:
    """What the side-car says, wrongly where `told` says so."""
    factor = told.get("wavelength", 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    band_nm = factor * (NARROW_H.centre_nm + NARROW_H.half_width_nm * nodes)
    spectrum = [
        {"wavelength_nm": float(wavelength_nm), "weight": float(weight)}
        for wavelength_nm, weight in zip(band_nm, weights, strict=True)
    ]
    detector = {"e_per_adu": told.get("e_per_adu", GAIN_E), "read_noise_e": told.get("read_noise_e", 1.0)}
    diversity = {told.get("noll", 6): DIVERSITY_NM * told.get("diversity", 1.0)}
    return {
        "role": told.get("role", "ncpa_calibration"),
        "target": "misled",
        "mag_j": of["mag_j"],
        "exposure_s": of["exposure_s"] * told.get("exposure_s", 1.0),
        "frame_rate_hz": 1 / of["exposure_s"],
        "pixel_scale_mas": 9.7 * told.get("pixel_scale_mas", 1.0),
        "spectrum": spectrum,
        "diversity": {"source": "lens", "zernike": diversity},
        "introduced_defocus_nm": told.get("introduced", 0.0) * told.get("offsets", 1.0),
        "detector": detector,
    } | ({"seeing_arcsec": of["seeing_arcsec"]} if sky else {})
