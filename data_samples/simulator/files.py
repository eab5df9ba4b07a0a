"""Files of a recording: SPARTA recorder folder, MUSE raw file, side-car and truth."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml
from astropy.io import fits

from simulator.campaign import SIDE_CAR_POINTS, Scene
from simulator.exposure import RawRecording
from simulator.telescope import Telescope

MUSE_MODE = "64x64_FullPupil_200Hz_HighGain"


def write_recorder_folder(folder: Path, scene: Scene, raw: RawRecording) -> None:
    """Write a SPARTA recorder folder: pixel table, dark, map of dead pixels, side-car."""
    folder.mkdir(parents=True, exist_ok=True)
    name = folder.name
    fits.HDUList([_primary_header(), _pixel_table(scene, raw)]).writeto(
        folder / f"{name}.fits", overwrite=True
    )
    fits.PrimaryHDU(raw.dark_adu).writeto(folder / "IRAcq.DET1.DARK.fits", overwrite=True)
    dead = np.zeros((scene.window_px, scene.window_px), dtype=np.uint8)
    for pixel in scene.detector.dead:
        dead[pixel] = 1
    fits.PrimaryHDU(dead).writeto(folder / "IRAcq.DET1.DEAD.fits", overwrite=True)
    write_side_car(folder / "acquisition.yaml", scene)


def write_muse_raw(path: Path, scene: Scene, raw: RawRecording) -> None:
    """Write a MUSE narrow-field raw file with the infrared cube and the SPARTA atmosphere table."""
    cube = fits.ImageHDU(raw.frames_adu, name="SPARTA_TT_CUBE")
    fits.HDUList([_muse_primary(scene), cube, _atmosphere_table(scene)]).writeto(path, overwrite=True)
    write_side_car(path.with_name(f"{path.stem}.yaml"), scene)


def write_side_car(path: Path, scene: Scene) -> None:
    """Write acquisition.yaml: what an observer knows, nothing of the truth."""
    detector = scene.detector
    content = {
        "role": scene.role,
        "target": scene.target,
        "mag_j": scene.mag_j,
        "exposure_s": scene.exposure_s,
        "frame_rate_hz": 1 / scene.exposure_s,
        "pixel_scale_mas": scene.pixel_scale_mas,
        "seeing_arcsec": scene.seeing_arcsec,
        "spectrum": [
            {"wavelength_nm": round(nm, 3), "weight": round(weight, 6)}
            for nm, weight in scene.spectrum(SIDE_CAR_POINTS)
        ],
        "diversity": {"source": "lens", "zernike": dict(scene.diversity_nm)},
        "introduced_defocus_nm": scene.introduced_defocus_nm,
        "detector": {"e_per_adu": detector.e_per_adu, "read_noise_e": detector.read_noise_e},
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def write_truth(
    path: Path, scene: Scene, raw: RawRecording, telescope: Telescope, residual: dict[str, float]
) -> None:
    """Write the truth: coefficients drawn, those of the mean wavefront, parameters of the simulation.

    `residual` is what is known of the AO residual besides the parameters of the scene.
    """
    told_above = {"ncpa_nm", "introduced_defocus_nm"}
    parameters = {key: value for key, value in asdict(scene).items() if key not in told_above}
    content = {
        "hidden": {},
        "ncpa_nm": scene.ncpa_nm,
        "introduced_defocus_nm": scene.introduced_defocus_nm,
        "mean_zernike_nm": telescope.fit_zernike_nm(raw.mean_opd_nm, scene.ncpa_nm),
        "simulation": parameters | {"photons_per_frame": scene.photons} | residual,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


def _primary_header() -> fits.PrimaryHDU:
    header = fits.Header([("TELESCOP", "ESO-VLT-U4"), ("INSTRUME", "MUSE")])
    return fits.PrimaryHDU(header=header)


def _pixel_table(scene: Scene, raw: RawRecording) -> fits.BinTableHDU:
    count, rows, columns = raw.frames_adu.shape
    ticks = round(scene.exposure_s * scene.loop_hz)
    microseconds = np.round(scene.exposed * scene.exposure_s * 1e6).astype(np.int64)
    integers = {
        "FrameCounter": scene.first_counter + ticks * scene.exposed,
        "Seconds": scene.start_s + microseconds // 1_000_000,
        "USeconds": microseconds % 1_000_000,
        "WindowSizeX": np.full(count, columns),
        "WindowSizeY": np.full(count, rows),
    }
    fields = [fits.Column(name, "J", array=values) for name, values in integers.items()]
    pixels = raw.frames_adu.reshape(count, -1)
    fields.append(fits.Column("Pixels", f"{rows * columns}I", bzero=32768, array=pixels))
    return fits.BinTableHDU.from_columns(fields, name="IRPixelFrame")


def _muse_primary(scene: Scene) -> fits.PrimaryHDU:
    hdu = _primary_header()
    hdu.header["OBJECT"] = scene.target
    hdu.header["DATE-OBS"] = f"{np.datetime64(scene.start_s, 's')}.000"
    hdu.header["EXPTIME"] = scene.frames * scene.exposure_s
    eso = {
        "AOS MAIN MODES IRLOS": MUSE_MODE,
        "SEQ NGS MAG": scene.mag_j,
        "TEL AMBI FWHM START": 0.62,
        "TEL PARANG START": -48.3,
        "TEL ALT": 71.4,
        "INS DROT START": 112.7,
        **{f"AOS NGS{quadrant} FLUX": scene.photons / 4 / scene.exposure_s for quadrant in range(1, 5)},
    }
    for key, value in eso.items():
        hdu.header[f"HIERARCH ESO {key}"] = value
    return hdu


def _atmosphere_table(scene: Scene) -> fits.BinTableHDU:
    seconds = scene.start_s + np.array([0, 30])
    columns = [fits.Column("Sec", "J", array=seconds), fits.Column("USec", "J", array=[0, 0])]
    for star in range(1, 5):
        seeing = scene.seeing_arcsec + 0.01 * np.array([0, 1]) * (-1) ** star
        columns.append(fits.Column(f"LGS{star}_SEEING", "E", unit="arcsec", array=seeing))
    return fits.BinTableHDU.from_columns(columns, name="SPARTA_ATM_DATA")
