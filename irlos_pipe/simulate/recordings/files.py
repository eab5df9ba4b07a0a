"""Writes one recording, frame after frame: SPARTA recorder folder or MUSE raw file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.planned import LOOP_HZ, Planned
from irlos_pipe.simulate.recordings.sidecar import side_car
from irlos_pipe.simulate.scene import Scene

UNSIGNED = 32768  # FITS has no unsigned integers: what is added to the stored ones
AMBIENT_OVER_SPARTA_SEEING = 1.2  # of the header's seeing, measured at the dome, against SPARTA's


class Layout(ABC):
    """Files of one recording.

    Parameters
    ----------
    planned : Planned
    """

    def __init__(self, planned: Planned):
        self._planned = planned

    @property
    def _scene(self) -> Scene:
        return self._planned.scene

    @abstractmethod
    def file_stem(self) -> str:
        """Return the name of the data file without suffix; the truth is named after it."""

    @abstractmethod
    def write(
        self, folder: Path, readout: Readout, frames_adu: Iterable[np.ndarray], rng: np.random.Generator
    ) -> None:
        """Write all files into an existing folder; frames are taken one by one.

        Parameters
        ----------
        folder : Path
        readout : Readout
        frames_adu : iterable of ndarray, (rows, columns) uint16, or int32 for sums of reads
            Raw frames.
        rng : numpy.random.Generator
            For the noise of the calibration images.
        """


class RecorderFolder(Layout):
    """SPARTA recorder folder: pixel table, calibration images, side-car."""

    def file_stem(self) -> str:
        """See `Layout.file_stem`."""
        return self._planned.name.rpartition("/")[2]

    def write(
        self, folder: Path, readout: Readout, frames_adu: Iterable[np.ndarray], rng: np.random.Generator
    ) -> None:
        """See `Layout.write`."""
        path = folder / f"{self.file_stem()}.fits"
        fits.PrimaryHDU(header=_primary_header(self._scene)).writeto(path)
        rows = (self._row(index, frame) for index, frame in enumerate(frames_adu))
        _append_streamed(path, _table_header(self._row_columns(), self._scene.frames, "IRPixelFrame"), rows)
        maps = {"DARK": readout.dark_adu(rng), "FLAT": readout.flat(rng), "DEAD": readout.dead()}
        for kind, image in maps.items():
            if image is not None:
                fits.PrimaryHDU(image).writeto(folder / f"IRAcq.DET1.{kind}.fits")
        _write_yaml(folder / "acquisition.yaml", side_car(self._planned))

    def _row_columns(self) -> list[fits.Column]:
        names = ("FrameCounter", "Seconds", "USeconds", "WindowSizeX", "WindowSizeY")
        pixels = int(np.prod(self._scene.window))
        own = (
            fits.Column("Pixels", f"{pixels}I", bzero=UNSIGNED)
            if self._scene.reads == 1
            else fits.Column("Pixels", f"{pixels}J")
        )
        return [*(fits.Column(name, "J") for name in names), own]

    def _row(self, index: int, frame_adu: np.ndarray) -> np.ndarray:
        """One row of the pixel table as bytes."""
        scene = self._scene
        microseconds = round(index * scene.period_s * 1e6)
        counter = scene.first_counter + index * max(1, round(scene.period_s * LOOP_HZ))
        seconds = scene.start_unix_s + microseconds // 1_000_000
        rows, columns = frame_adu.shape
        head = np.array([counter, seconds, microseconds % 1_000_000, columns, rows], ">i4")
        return np.concatenate([head.view(np.uint8), _as_signed(frame_adu).ravel().view(np.uint8)])


class MuseRaw(Layout):
    """MUSE raw file: cube of the infrared sensor, table of the atmosphere, side-car."""

    def file_stem(self) -> str:
        """See `Layout.file_stem`."""
        return f"MUSE.{_iso_time(self._scene.start_unix_s)}"

    def write(
        self, folder: Path, readout: Readout, frames_adu: Iterable[np.ndarray], rng: np.random.Generator
    ) -> None:
        """See `Layout.write`."""
        path = folder / f"{self.file_stem()}.fits"
        fits.PrimaryHDU(header=self._muse_header()).writeto(path)
        framed = (self._with_borders(frame) for frame in frames_adu)
        _append_streamed(path, self._cube_header(), (_as_signed(frame) for frame in framed))
        table = self._atmosphere_table()
        fits.append(path, table.data, table.header)
        if self._planned.side_car:
            _write_yaml(folder / f"{self.file_stem()}.yaml", side_car(self._planned))

    def _with_borders(self, frame: np.ndarray) -> np.ndarray:
        """The frame, in 2x2 modes with a border of zeros around each of its four images."""
        if self._scene.lenslets == 1:
            return frame
        halves = [np.hsplit(half, 2) for half in np.vsplit(frame, 2)]
        return np.block([[np.pad(image, 1) for image in half] for half in halves])

    def _cube_header(self) -> fits.Header:
        rows, columns = self._with_borders(np.zeros(self._scene.window)).shape
        cards = [
            ("XTENSION", "IMAGE"),
            ("BITPIX", 16 if self._scene.reads == 1 else 32),
            ("NAXIS", 3),
            ("NAXIS1", columns),
            ("NAXIS2", rows),
            ("NAXIS3", self._scene.frames),
            ("PCOUNT", 0),
            ("GCOUNT", 1),
            ("BSCALE", 1),
            ("BZERO", UNSIGNED if self._scene.reads == 1 else 0),
            ("EXTNAME", "SPARTA_TT_CUBE"),
            ("BUNIT", "adu"),
        ]
        return fits.Header(cards)

    def _muse_header(self) -> fits.Header:
        scene, header = self._scene, _primary_header(self._scene)
        header["EXPTIME"] = scene.frames * scene.exposure_s
        eso = {
            "AOS MAIN MODES IRLOS": self._planned.mode,
            "SEQ NGS MAG": scene.mag_j,
            "INS DROT START": scene.derotator_angle_deg,
            **{f"AOS NGS{number} FLUX": scene.photons / 4 / scene.exposure_s for number in range(1, 5)},
        }
        if scene.sky is not None:
            eso["TEL AMBI FWHM START"] = scene.sky.seeing_arcsec * AMBIENT_OVER_SPARTA_SEEING
        for key, value in eso.items():
            header[f"HIERARCH ESO {key}"] = value
        return header

    def _atmosphere_table(self) -> fits.BinTableHDU:
        """Seeing at the beginning and the end, as each of the four laser stars sees it."""
        scene = self._scene
        seconds = scene.start_unix_s + np.array([0, int(np.ceil(scene.frames * scene.period_s))])
        columns = [fits.Column("Sec", "J", array=seconds), fits.Column("USec", "J", array=[0, 0])]
        seeing = scene.sky.seeing_arcsec if scene.sky is not None else 0.0
        columns += [
            fits.Column(f"LGS{star}_SEEING", "E", unit="arcsec", array=[seeing, seeing])
            for star in range(1, 5)
        ]
        return fits.BinTableHDU.from_columns(columns, name="SPARTA_ATM_DATA")


LAYOUTS = {"recorder": RecorderFolder, "muse_raw": MuseRaw}


def layout_of(planned: Planned) -> Layout:
    """Return the writer for a `planned` recording."""
    return LAYOUTS[planned.layout](planned)


def _append_streamed(path: Path, header: fits.Header, blocks: Iterable[np.ndarray]) -> None:
    """Append an HDU whose data come block after block; memory does not grow with their number."""
    stream = fits.StreamingHDU(str(path), header)
    try:
        for block in blocks:
            stream.write(block)
    finally:
        stream.close()


def _table_header(columns: list[fits.Column], rows: int, name: str) -> fits.Header:
    header = fits.BinTableHDU.from_columns(columns, nrows=0, name=name).header
    header["NAXIS2"] = rows
    return header


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


def _write_yaml(path: Path, content: dict) -> None:
    path.write_text(yaml_text(content))
