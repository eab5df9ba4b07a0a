"""Recordings: simulated, spoilt as a case says, and written with what is declared of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits

from benchmarks.misled.cases import RAMP, SKY, Case, Change, Taken
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.readout import electrons
from irlos_pipe.simulate.scene import Sampling, Scene, draw_ncpa_nm

FACILITY = load_instrument("irlos").facility
TOTAL_NM = 142.0  # RMS in Noll 2 to 51
THROUGHPUT = 0.047  # throughput of the narrow band, relative to J and H
DIVERSITY_NM = -170.0
GAIN_E, PEDESTAL_ADU = 0.5, 200.0
OFFSETS_NM = (-200.0, -100.0, 0.0, 100.0, 200.0)
USUAL: dict[str, Any] = {
    "frames": 40,
    "mag_j": 7.5,
    "exposure_s": 0.1,
    "window": (40, 40),
    "seeing_arcsec": 0.6,
    "shape": "power_law",
}
RAMP_USUAL: dict[str, Any] = {"frames": 4, "mag_j": 9.0, "exposure_s": 0.5}
SMALL_PX = 24
ASIDE_PX = 6  # displacement of frames at most
FOCUS_STEP, FOCUS_STEP_NM = "defocus of 60 nm more half way", 60.0
# Displacement of the frames along x [px] by their time, 0 to 1.
STEPS_PX: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "jump of 1 px half way": lambda time, rng: np.where(time < 0.5, 0, 1),
    "jump of 2 px half way": lambda time, rng: np.where(time < 0.5, 0, 2),
    "jump of 3 px half way": lambda time, rng: np.where(time < 0.5, 0, 3),
    "two pointings by turns": lambda time, rng: 2 * (np.arange(len(time)) % 2),
    "jumps of 1.5 px": lambda time, rng: np.rint(rng.normal(0, 1.5, len(time))).astype(int),
}
# Scenes of the frames that differ from the others.
SECOND: dict[str, Callable[[Scene], Scene]] = {
    "half of another star": lambda scene: replace(
        scene, ncpa_nm={noll: -nm for noll, nm in scene.ncpa_nm.items()}
    ),
    "seeing twice as strong half way": lambda scene: replace(
        scene, sky=scene.sky and replace(scene.sky, seeing_arcsec=2 * scene.sky.seeing_arcsec)
    ),
    FOCUS_STEP: lambda scene: replace(scene, ncpa_nm=scene.ncpa_nm | {4: scene.ncpa_nm[4] + FOCUS_STEP_NM}),
    "half as bright half way": lambda scene: replace(scene, mag_j=scene.mag_j + 0.75),
}


@dataclass(frozen=True)
class Made:
    """Folders of the recordings by the recipe's input, and what is true."""

    inputs: dict[str, list[Path]]
    ncpa_nm: dict[int, float]  # static modes of the calibration, Noll: nm RMS
    # True defocus of the recordings of the ramp, by name.
    introduced_nm: dict[str, float] = field(default_factory=dict)


def make_case(case: Case, folder: Path) -> Made:
    """Write the recordings of a `case` into a `folder`, which must exist."""
    wrong = case.taken
    if case.kind != RAMP:
        cube = make_cube(case, wrong, folder / "cube", case.usual)
        return Made({"calibration": [cube], "cube": [cube]}, ncpa_of(case, wrong))
    foreign = Taken(foreign=case.family == "calibration of another instrument")
    calibrated = replace(wrong, hidden={}) if case.both else foreign
    seeing = {key: case.usual[key] for key in ("seeing_arcsec",) if key in case.usual}
    cube = make_cube(case, calibrated, folder / "cube", seeing)
    ramp, introduced = make_ramp(case, wrong, folder, case.usual)
    return Made({"calibration": [cube], "ramp": ramp}, ncpa_of(case, calibrated), introduced)


def ncpa_of(case: Case, taken: Taken) -> dict[int, float]:
    """Return the mean static modes with which something was `taken`, Noll: nm RMS."""
    return _drawn_nm(case, taken) | (
        {4: _drawn_nm(case, taken)[4] + FOCUS_STEP_NM / 2} if taken.seen == FOCUS_STEP else {}
    )


def _drawn_nm(case: Case, taken: Taken) -> dict[int, float]:
    rng = np.random.default_rng(case.seed + int(taken.foreign))
    return draw_ncpa_nm(rng, FACILITY.ncpa_law, TOTAL_NM)


def make_cube(
    case: Case, taken: Taken, folder: Path, usual: Change, stream: int = 0, begin_s: int | None = None
) -> Path:
    """Write a calibration cube; returns its folder, which must not exist.

    The `case` gives setting and seed, `taken` what is wrong, `stream` the random numbers. It begins at
    `begin_s` since 1970; a plain FITS cube without times if None.
    """
    images = _images(case, taken, usual, stream)
    return _written(folder, images, _sidecar(case, usual, taken.told), begin_s)


def make_ramp(
    case: Case, taken: Taken, folder: Path, usual: Change, begin_s: int | None = None
) -> tuple[list[Path], dict[str, float]]:
    """Write the recordings of a ramp, see `make_cube`; returns their folders and true defocus by name."""
    usual = RAMP_USUAL | dict(usual)
    as_told = [OFFSETS_NM[index] for index in taken.told.get("order", range(len(OFFSETS_NM)))]
    recordings = []
    for index, offset_nm in enumerate(OFFSETS_NM):
        images = _images(case, taken, usual, 1 + index, offset_nm)
        told = {"introduced": as_told[index], "role": "defocus_ramp"} | dict(taken.told)
        start_s = None if begin_s is None else begin_s + 60 * index
        keys = _sidecar(case, usual, told)
        recordings.append(_written(folder / f"offset_{index}", images, keys, start_s))
    return recordings, dict(zip((path.name for path in recordings), OFFSETS_NM, strict=True))


def _scene(case: Case, taken: Taken, usual: Change, stream: int, offset_nm: float) -> Scene:
    of = USUAL | dict(usual)
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
        ncpa_nm=_drawn_nm(case, taken),
        diversity_nm={6: DIVERSITY_NM},
        introduced_nm=offset_nm,
        sky=Sky(of["seeing_arcsec"], shape=of["shape"]) if sky else None,
        motion=Motion(7.0) if sky else None,
        effects=taken.hidden,
        detector=DetectorModel(e_per_adu=GAIN_E),
        sampling=Sampling(points_per_band=2, step_s=0.03),
    )


def _images(case: Case, taken: Taken, usual: Change, stream: int, offset_nm: float = 0.0) -> np.ndarray:
    """Frames in electrons, (frames, rows, columns)."""
    if taken.seen in STEPS_PX:
        rows, columns = usual.get("window", USUAL["window"])
        usual = dict(usual) | {"window": (rows, columns + 2 * ASIDE_PX)}
    return _spoilt(case, taken, usual, _frames(_scene(case, taken, usual, stream, offset_nm)))


def _frames(scene: Scene) -> np.ndarray:
    return electrons(scene, expose(scene).mean_e, np.random.default_rng([*scene.seed, 7]))


def _spoilt(case: Case, taken: Taken, usual: Change, images: np.ndarray) -> np.ndarray:
    """What is wrong with the images themselves."""
    rows, columns = images.shape[1:]
    half = len(images) // 2
    if taken.seen in SECOND:
        change = SECOND[taken.seen](_scene(case, Taken(), usual, 9, 0.0))
        second = _frames(change)
        if taken.seen == "half of another star":
            return np.concatenate([images[::2], second[1::2]])
        return np.concatenate([images[:half], second[half:]])
    if taken.seen in STEPS_PX:
        rng = np.random.default_rng([case.seed, 8])
        steps = np.clip(STEPS_PX[taken.seen](np.arange(len(images)) / len(images), rng), -ASIDE_PX, ASIDE_PX)
        first = ASIDE_PX - steps
        return np.stack(
            [one[:, at : at + columns - 2 * ASIDE_PX] for one, at in zip(images, first, strict=True)]
        )
    top, left = (rows - SMALL_PX) // 2, (columns - SMALL_PX) // 2
    return {
        "": lambda: images,
        "flipped left to right": lambda: images[:, :, ::-1],
        "flipped up and down": lambda: images[:, ::-1],
        "turned by 180°": lambda: images[:, ::-1, ::-1],
        "transposed": lambda: images.transpose(0, 2, 1),
        "window of 5 λ/D": lambda: images[:, top : top + SMALL_PX, left : left + SMALL_PX],
        "three frames": lambda: images[:3],
        "frames twice": lambda: np.concatenate([images, images]),
        "core clipped": lambda: np.minimum(images, 0.5 * images.mean(0).max()),
    }[taken.seen]()


def _written(folder: Path, images: np.ndarray, keys: dict[str, Any], begin_s: int | None) -> Path:
    """Write the data file and its side-car; returns the folder."""
    folder.mkdir(parents=True)
    adu = np.clip(np.rint(images / GAIN_E + PEDESTAL_ADU), 0, 65535).astype(np.uint16)
    path = folder / f"{folder.name}.fits"
    if begin_s is None:
        fits.PrimaryHDU(adu).writeto(path)
    else:
        _recorder_table(adu, begin_s + np.arange(len(adu)) * keys["exposure_s"]).writeto(path)
    (folder / "acquisition.yaml").write_text(yaml.safe_dump(keys))
    return folder


def _recorder_table(adu: np.ndarray, unix_s: np.ndarray) -> fits.BinTableHDU:
    """The pixel table of the recorder."""
    frames, rows, columns = adu.shape
    numbers = {
        "FrameCounter": 1000 + np.arange(frames),
        "Seconds": unix_s.astype(int),
        "USeconds": (unix_s % 1 * 1e6).astype(int),
        "WindowSizeX": np.full(frames, columns),
        "WindowSizeY": np.full(frames, rows),
    }
    pixels = fits.Column("Pixels", f"{rows * columns}I", bzero=32768, array=adu.reshape(frames, -1))
    plain = [fits.Column(name, "J", array=values) for name, values in numbers.items()]
    return fits.BinTableHDU.from_columns([*plain, pixels], name="IRPixelFrame")


def _sidecar(case: Case, usual: Change, told: Change) -> dict[str, Any]:
    """What the side-car says, wrongly where `told` says so."""
    of = USUAL | dict(usual)
    factor = told.get("wavelength", 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    band_nm = factor * (NARROW_H.centre_nm + NARROW_H.half_width_nm * nodes)
    spectrum = [
        {"wavelength_nm": float(wavelength_nm), "weight": float(weight)}
        for wavelength_nm, weight in zip(band_nm, weights, strict=True)
    ]
    detector = {"e_per_adu": told.get("e_per_adu", GAIN_E), "read_noise_e": told.get("read_noise_e", 1.0)}
    diversity = {told.get("noll", 6): DIVERSITY_NM * told.get("diversity", 1.0)}
    introduced_nm = told.get("introduced", 0.0) * told.get("offsets", 1.0) + told.get("beside_nm", 0.0)
    seeing = {"seeing_arcsec": of["seeing_arcsec"] * told.get("seeing_arcsec", 1.0)}
    return {
        "role": told.get("role", "ncpa_calibration"),
        "target": "misled",
        "mag_j": of["mag_j"],
        "exposure_s": of["exposure_s"] * told.get("exposure_s", 1.0),
        "frame_rate_hz": 1 / of["exposure_s"],
        "pixel_scale_mas": 9.7 * told.get("pixel_scale_mas", 1.0),
        "spectrum": spectrum,
        "diversity": {"source": "lens", "zernike": diversity},
        "introduced_defocus_nm": introduced_nm,
        "detector": detector,
    } | (seeing if case.setting == SKY else {})
