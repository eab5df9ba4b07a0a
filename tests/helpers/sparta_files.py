"""Small recordings with known content, written in each of the layouts that ingest reads."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits

SIDECAR = {
    "role": "ncpa_calibration",
    "target": "TEST",
    "mag_j": 8.0,
    "exposure_s": 0.1,
    "frame_rate_hz": 10.0,
    "pixel_scale_mas": 9.7,
    "seeing_arcsec": 0.5,
    "spectrum": [{"wavelength_nm": 1600.0, "weight": 1.0}],
    "diversity": {"source": "lens", "zernike": {6: -170.0}},
    "introduced_defocus_nm": 0.0,
    "detector": {"e_per_adu": 0.5, "read_noise_e": 1.0},
}
FULL_PUPIL = "64x64_FullPupil_200Hz_HighGain"
TWO_BY_TWO = "20x20_SmallScale_500Hz_HighGain"
SAMPLING_PX = 4.25  # pixels per lambda/D of `SIDECAR` on an 8 m pupil


def star(
    rows: int = 32, columns: int = 32, flux_e: float = 1e6, seed: int = 0, shift_px=(0.0, 0.0)
) -> np.ndarray:
    """Image (rows, columns) of a star through an aberrated pupil [e-], the flux all inside the window."""
    across = np.linspace(-0.5, 0.5, 33)
    y, x = np.meshgrid(across, across, indexing="ij")
    a = np.random.default_rng(seed).normal(0, 1.0, 6)
    phase = a[0] * x + a[1] * y + 3 * (a[2] * x * y + a[3] * (x**2 - y**2)) + 6 * a[4] * (x**2 + y**2) * x
    field = (np.hypot(x, y) <= 0.5) * np.exp(1j * phase)
    row, column = (
        np.arange(size) - (size - 1) / 2 - move for size, move in zip((rows, columns), shift_px, strict=True)
    )
    transform_y = np.exp(-2j * np.pi * np.outer(row, across) / SAMPLING_PX)
    transform_x = np.exp(-2j * np.pi * np.outer(across, column) / SAMPLING_PX)
    image = np.abs(transform_y @ field @ transform_x) ** 2
    return flux_e * image / image.sum()


def frames_e(image_e: np.ndarray, frames: int, read_noise_e: float = 1.0, seed: int = 1) -> np.ndarray:
    """Noisy frames (frames, rows, columns) of an image [e-]."""
    rng = np.random.default_rng(seed)
    shape = (frames, *image_e.shape)
    return rng.poisson(image_e, shape) + rng.normal(0, read_noise_e, shape)


def counts(image_e: np.ndarray, frames: int = 12, pedestal_adu: float = 50.0, seed: int = 1) -> np.ndarray:
    """Raw counts of an image, at the gain and read noise of `SIDECAR`, float32 [ADU]."""
    return (frames_e(image_e, frames, seed=seed) / 0.5 + pedestal_adu).astype(np.float32)


def sidecar(*without: str, **changes: Any) -> dict[str, Any]:
    keys = copy.deepcopy(SIDECAR) | changes
    return {key: value for key, value in keys.items() if key not in without}


def write_sidecar(path: Path, *without: str, **changes: Any) -> Path:
    path.write_text(yaml.safe_dump(sidecar(*without, **changes), sort_keys=False))
    return path


def pixel_table(
    adu: np.ndarray, counter=None, pad: int = 0, times: dict | None = None, sizes: tuple | None = None
) -> fits.BinTableHDU:
    """Table IRPixelFrame of a cube (frames, rows, columns), vectors padded with `pad` values of -999."""
    frames, rows, columns = adu.shape
    vectors = np.pad(adu.reshape(frames, rows * columns), ((0, 0), (0, pad)), constant_values=-999)
    width, height = sizes or (np.full(frames, columns), np.full(frames, rows))
    counter = 20 * np.arange(frames) if counter is None else counter
    table = [
        fits.Column("FrameCounter", "J", array=counter),
        fits.Column("WindowSizeX", "J", array=width),
        fits.Column("WindowSizeY", "J", array=height),
        fits.Column("Pixels", f"{vectors.shape[1]}E", array=vectors),
    ]
    table += [fits.Column(name, "J", array=values) for name, values in (times or {}).items()]
    return fits.BinTableHDU.from_columns(table, name="IRPixelFrame")


def loop_table(counter, seconds, microseconds) -> fits.BinTableHDU:
    return fits.BinTableHDU.from_columns(
        [
            fits.Column("FrameCounter", "J", array=counter),
            fits.Column("Seconds", "J", array=seconds),
            fits.Column("USeconds", "J", array=microseconds),
        ],
        name="IRLoopFrame",
    )


def write_recorder(
    folder: Path,
    adu: np.ndarray,
    *more: fits.BinTableHDU,
    maps: dict | None = None,
    keys: dict | None = None,
    **table: Any,
) -> Path:
    """Write a recorder folder with its calibration images and side-car; return the data file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{folder.name}.fits"
    fits.HDUList([fits.PrimaryHDU(), pixel_table(adu, **table), *more]).writeto(path, overwrite=True)
    for kind, image in (maps or {}).items():
        fits.writeto(folder / f"IRAcq.DET1.{kind}.fits", np.asarray(image, np.float32), overwrite=True)
    write_sidecar(folder / "acquisition.yaml", **(keys or {}))
    return path


def write_muse(
    path: Path,
    adu: np.ndarray,
    mode: str | None = FULL_PUPIL,
    header: dict | None = None,
    seeing: list[float] | None = None,
) -> Path:
    primary = fits.PrimaryHDU()
    primary.header["DATE-OBS"] = "2023-07-14T03:21:10.000"
    for key, value in ({"ESO AOS MAIN MODES IRLOS": mode} | (header or {})).items():
        if value is not None:
            primary.header[f"HIERARCH {key}" if " " in key else key] = value
    hdus = [primary, fits.ImageHDU(adu, name="SPARTA_TT_CUBE")]
    if seeing is not None:
        hdus.append(
            fits.BinTableHDU.from_columns(
                [
                    fits.Column("Sec", "J", array=1689304870 + np.arange(len(seeing))),
                    fits.Column("USec", "J", array=np.zeros(len(seeing), int)),
                    fits.Column("LGS1_SEEING", "E", array=seeing),
                ],
                name="SPARTA_ATM_DATA",
            )
        )
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def quadrants(images: list[np.ndarray]) -> np.ndarray:
    """Four cubes (lower left, lower right, upper left, upper right) in one, each with a border of zeros."""
    a, b, c, d = (np.pad(cube, ((0, 0), (1, 1), (1, 1))) for cube in images)
    return np.concatenate([np.concatenate([a, b], axis=2), np.concatenate([c, d], axis=2)], axis=1)
