"""A recording to be made and its files, written frame after frame: SPARTA recorder folder or MUSE raw file.

Worker processes need no more of a spec than this, and load no model.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.simulate.detector import ADC_TOP_ADU, DetectorModel
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.scene import Scene

LOOP_HZ = 200
BYTES_PER_VALUE, BYTES_PER_SUM = 2, 4  # in the file: of a read, and of a sum of reads
DOUBLE = "__"  # replaces '/' in the names of truth files
UNSIGNED = 32768  # BZERO: FITS has no unsigned integers
AMBIENT_OVER_SPARTA_SEEING = 1.2  # of the header's seeing, measured at the dome, against SPARTA's
SIDE_CAR_POINTS = 3  # wavelengths per band that a side-car lists
Defocus = float | tuple[float, ...]  # of all frames, or of every frame [nm RMS]


@dataclass(frozen=True)
class Planned:
    name: str  # calibration, or ramp/offset_03 in a series
    scene: Scene  # what happens; the defocus is what the focus stage reaches
    commanded_nm: Defocus  # introduced defocus as commanded, which the side-car states
    hidden: Mapping[str, Mapping[str, Any]]  # effects that it does not, those of the focus stage included
    layout: str
    mode: str  # mode string of a MUSE file
    side_car: bool = True  # whether one is written; a MUSE file may do without
    instrument: str = ""  # profile that the side-car states

    @property
    def size_bytes(self) -> int:
        each = BYTES_PER_VALUE if self.scene.reads == 1 else BYTES_PER_SUM
        return self.scene.frames * self.scene.window[0] * self.scene.window[1] * each

    @property
    def file_stem(self) -> str:
        """Name of the data file without suffix; the truth is named after it."""
        if self.layout == "muse_raw":
            return f"MUSE.{_iso_time(self.scene.start_unix_s)}"
        return self.name.rpartition("/")[2]


def write_files(
    planned: Planned,
    folder: Path,
    readout: Readout,
    frames_adu: Iterable[np.ndarray],
    rng: np.random.Generator,
) -> None:
    """Write all files of a `planned` recording into an existing `folder`.

    The raw `frames_adu`, (rows, columns) uint16, or int32 for sums of reads, are taken one by one; the noise
    of the calibration images of the `readout` is drawn from `rng`.
    """
    path = folder / f"{planned.file_stem}.fits"
    if planned.layout == "muse_raw":
        _write_muse(planned, path, frames_adu)
        if planned.side_car:
            path.with_suffix(".yaml").write_text(yaml_text(side_car(planned)))
        return
    pixels = int(np.prod(planned.scene.window))
    names = ("FrameCounter", "Seconds", "USeconds", "WindowSizeX", "WindowSizeY")
    columns = [fits.Column(name, "J") for name in names]
    if planned.scene.reads == 1:
        columns.append(fits.Column("Pixels", f"{pixels}I", bzero=UNSIGNED))
    else:
        columns.append(fits.Column("Pixels", f"{pixels}J"))
    header = fits.BinTableHDU.from_columns(columns, nrows=0, name="IRPixelFrame").header
    header["NAXIS2"] = planned.scene.frames
    fits.PrimaryHDU(header=_primary_header(planned.scene)).writeto(path)
    _append_streamed(
        path, header, (_row(planned.scene, index, frame) for index, frame in enumerate(frames_adu))
    )
    maps = {"DARK": readout.dark_adu(rng), "FLAT": readout.flat(rng), "DEAD": readout.dead()}
    for kind, image in maps.items():
        if image is not None:
            fits.PrimaryHDU(image).writeto(folder / f"IRAcq.DET1.{kind}.fits")
    (folder / "acquisition.yaml").write_text(yaml_text(side_car(planned)))


def _row(scene: Scene, index: int, frame_adu: np.ndarray) -> np.ndarray:
    microseconds = round(index * scene.period_s * 1e6)
    counter = scene.first_counter + index * max(1, round(scene.period_s * LOOP_HZ))
    seconds = scene.start_unix_s + microseconds // 1_000_000
    rows, columns = frame_adu.shape
    head = np.array([counter, seconds, microseconds % 1_000_000, columns, rows], ">i4")
    return np.concatenate([head.view(np.uint8), _as_signed(frame_adu).ravel().view(np.uint8)])


def _write_muse(planned: Planned, path: Path, frames_adu: Iterable[np.ndarray]) -> None:
    """Cube of the infrared sensor, and a table of the atmosphere."""
    scene, lenslets = planned.scene, planned.scene.lenslets
    rows, columns = _with_borders(np.zeros(scene.window), lenslets).shape
    cards = [
        ("XTENSION", "IMAGE"),
        ("BITPIX", 16 if scene.reads == 1 else 32),
        ("NAXIS", 3),
        ("NAXIS1", columns),
        ("NAXIS2", rows),
        ("NAXIS3", scene.frames),
        ("PCOUNT", 0),
        ("GCOUNT", 1),
        ("BSCALE", 1),
        ("BZERO", UNSIGNED if scene.reads == 1 else 0),
        ("EXTNAME", "SPARTA_TT_CUBE"),
        ("BUNIT", "adu"),
    ]
    fits.PrimaryHDU(header=_muse_header(planned)).writeto(path)
    stored = (_as_signed(_with_borders(frame, lenslets)) for frame in frames_adu)
    _append_streamed(path, fits.Header(cards), stored)
    table = _atmosphere_table(scene)
    fits.append(path, table.data, table.header)


def _with_borders(frame: np.ndarray, lenslets: int) -> np.ndarray:
    """The frame, in 2x2 modes with a border of zeros around each of its four images."""
    if lenslets == 1:
        return frame
    halves = [np.hsplit(half, 2) for half in np.vsplit(frame, 2)]
    return np.block([[np.pad(image, 1) for image in half] for half in halves])


def _muse_header(planned: Planned) -> fits.Header:
    scene, header = planned.scene, _primary_header(planned.scene)
    header["EXPTIME"] = scene.frames * scene.exposure_s
    eso = {
        "AOS MAIN MODES IRLOS": planned.mode,
        "SEQ NGS MAG": scene.mag_j,
        "INS DROT START": scene.derotator_angle_deg,
        **{f"AOS NGS{number} FLUX": scene.photons / 4 / scene.exposure_s for number in range(1, 5)},
    }
    if scene.sky is not None:
        eso["TEL AMBI FWHM START"] = scene.sky.seeing_arcsec * AMBIENT_OVER_SPARTA_SEEING
    for key, value in eso.items():
        header[f"HIERARCH ESO {key}"] = value
    return header


def _atmosphere_table(scene: Scene) -> fits.BinTableHDU:
    """Seeing at the beginning and the end, as each of the four laser stars sees it."""
    seconds = scene.start_unix_s + np.array([0, int(np.ceil(scene.frames * scene.period_s))])
    seeing = scene.sky.seeing_arcsec if scene.sky is not None else 0.0
    columns = [fits.Column("Sec", "J", array=seconds), fits.Column("USec", "J", array=[0, 0])]
    for star in range(1, 5):
        columns.append(fits.Column(f"LGS{star}_SEEING", "E", unit="arcsec", array=[seeing, seeing]))
    return fits.BinTableHDU.from_columns(columns, name="SPARTA_ATM_DATA")


def _append_streamed(path: Path, header: fits.Header, blocks: Iterable[np.ndarray]) -> None:
    """Append an HDU whose data come block after block; memory does not grow with their number."""
    stream = fits.StreamingHDU(str(path), header)
    try:
        for block in blocks:
            stream.write(block)
    finally:
        stream.close()


def _as_signed(frame_adu: np.ndarray) -> np.ndarray:
    """Whole ADU as FITS stores them, big-endian: unsigned ones of a read shifted to signed."""
    if frame_adu.dtype != np.uint16:
        return frame_adu.astype(">i4")
    return (frame_adu.astype(np.int32) - UNSIGNED).astype(">i2")


def _primary_header(scene: Scene) -> fits.Header:
    return fits.Header(
        [
            ("TELESCOP", "ESO-VLT-U4"),
            ("INSTRUME", "MUSE"),
            ("OBJECT", scene.target),
            ("DATE-OBS", _iso_time(scene.start_unix_s)),
            ("ORIGIN", "irlos simulate"),
        ]
    )


def _iso_time(unix_s: int) -> str:
    return f"{np.datetime64(unix_s, 's')}.000"


def side_car(planned: Planned) -> dict[str, Any]:
    """Return the side-car of a `planned` recording: what an observer knows, nothing of the truth."""
    scene, commanded_nm = planned.scene, planned.commanded_nm
    stated: dict[str, Any] = {
        "role": scene.role,
        "instrument": planned.instrument or None,
        "target": scene.target,
        "mag_j": scene.mag_j,
        "exposure_s": scene.exposure_s,
        "frame_rate_hz": scene.frame_rate_hz,
        "pixel_scale_mas": scene.pixel_scale_mas,
        "seeing_arcsec": scene.sky.seeing_arcsec if scene.sky is not None else None,
        "spectrum": declared_spectrum(scene),
        "diversity": {"source": scene.diversity_source, "zernike": dict(scene.diversity_nm)},
        "introduced_defocus_nm": list(commanded_nm) if isinstance(commanded_nm, tuple) else commanded_nm,
        "derotator_angle_deg": scene.derotator_angle_deg,
        "pupil_rotation_deg": scene.pupil_rotation_deg or None,
        "sky_e_per_s": float(f"{scene.sky_e_per_s:.3g}") or None,
        "detector": _declared_detector(scene.detector, scene.reads),
    }
    return {key: value for key, value in stated.items() if value is not None}


def declared_spectrum(scene: Scene) -> list[dict[str, float]]:
    """Return a few wavelengths per band of a `scene` with their photon weights."""
    weights: dict[float, float] = {}
    for wavelength_nm, weight in scene.spectrum(SIDE_CAR_POINTS):
        at = round(wavelength_nm, 3)  # the points of a band without width are the same
        weights[at] = weights.get(at, 0.0) + weight
    return [{"wavelength_nm": at, "weight": round(weight, 6)} for at, weight in weights.items()]


def _declared_detector(detector: DetectorModel, reads: int) -> dict[str, float]:
    stated = {"e_per_adu": detector.e_per_adu, "read_noise_e": detector.read_noise_e}
    if detector.excess_noise_factor != 1:
        stated["excess_noise_factor"] = detector.excess_noise_factor
    if detector.saturation_adu < ADC_TOP_ADU or reads > 1:
        stated["saturation_adu"] = min(detector.saturation_adu, ADC_TOP_ADU)
    if detector.read_s is not None:
        stated |= {"coadds": reads, "read_s": detector.read_s}
    if detector.dark_e_per_s:
        stated["dark_e_per_s"] = detector.dark_e_per_s
    return stated
