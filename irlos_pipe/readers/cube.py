"""Plain FITS cube (frames, y, x), image (y, x), or one frame per extension."""

import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.text import printable
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.acquisition import RawRecording, plain_header_keys
from irlos_pipe.readers.fitsfile import (
    MIN_WINDOW_PX,
    file_header,
    has_image,
    hdu_label,
    image_array,
    image_shape,
    stem,
)

LAYOUT = "fits_cube"
NUMBERED = re.compile(r"(.*?)[ _.-]?(\d+)")  # FRAME12, SCI_1
# Names that science images usually have, and those of what comes with them.
SCIENCE = re.compile(r"PRIMARY|SCI|SCIENCE|DATA|CUBE|IMAGES?|FRAMES?|RAW|")
COMPANION = re.compile(
    r"(\w+[_.-])?(DQ|BPM|(BAD)?(PIX(EL)?)?[_.-]?MASK|FLAGS?|ERR(ORS?)?|SIGMA|RMS|STD|UNCERT\w*|(IN?)?VAR(IANCE)?|"
    r"STAT|W(EI)?G?HT|COVERAGE|EXP(MAP|OSURE)?|DARK|FLAT|SKY|BKG|BACKGROUND|PREVIEW|THUMB(NAIL)?)"
)

MOSAIC = re.compile(r"CCD|CHIP|CHAN(NEL)?|AMP|DET(ECTOR)?|QUAD(RANT)?|Q|IFU|SEG(MENT)?")
SHOWN = 6


@dataclass(frozen=True, eq=False)
class _Image:
    index: int
    hdu: fits.hdu.base._BaseHDU

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Its axes, a single plane without the axis of frames."""
        shape = image_shape(self.hdu)
        return shape[1:] if len(shape) == 3 and shape[0] == 1 else shape

    @cached_property
    def name(self) -> str:
        return "" if self.index == 0 else self.hdu.name.strip().upper()

    @cached_property
    def series(self) -> str:
        numbered = NUMBERED.fullmatch(self.name)
        return numbered[1] if numbered else self.name

    @cached_property
    def number(self) -> int:
        """Of the frame, by its name or its version."""
        numbered = NUMBERED.fullmatch(self.name)
        return int(numbered[2]) if numbered else self.hdu.ver

    @property
    def label(self) -> str:
        return f"HDU {self.index}" + (f" ({printable(self.name)})" if self.name else "")


def recognises(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file has an image that could be a cube."""
    return any(map(has_image, hdus))


def read(path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
    """See `irlos_pipe.readers.find.Reader.read`.

    The recording is known by its shape, not its place: a cube before images, and of these a series of one
    window and name (``SCI,1`` to ``SCI,12``, ``FRAME1`` to ``FRAME12``, all without a name).

    Raises `InputDataError` for several images that could each be the recording, or one of a wrong shape.
    """
    images = [_Image(index, hdu) for index, hdu in enumerate(hdus) if has_image(hdu)]
    frames = _recording(path, images)
    adu = [image_array(one.hdu, hdu_label(path, one.index, one.hdu)) for one in frames]
    numbers = np.array([one.number for one in frames])
    counted = len(frames) > 1 and np.all(np.diff(numbers) > 0)
    header, notes = plain_header_keys(path, file_header(hdus), instrument)
    return [
        RawRecording(
            name=stem(path),
            path=path,
            layout=LAYOUT,
            adu=adu[0] if len(adu) == 1 else np.concatenate(adu),
            frame_counter=numbers if counted else np.arange(sum(map(len, adu))),
            header=header,
            notes=notes,
            warnings=_unread(path, [one for one in images if one not in frames]),
        )
    ]


def _recording(path: Path, images: list[_Image]) -> list[_Image]:
    """The images that are the recording: one, or one per frame in their order."""
    usable = [one for one in images if len(one.shape) in (2, 3) and min(one.shape[-2:]) >= MIN_WINDOW_PX]
    usable = [one for one in usable if not COMPANION.fullmatch(one.series)] or usable or images
    cubes = [one for one in usable if len(one.shape) == 3]
    groups: dict[tuple, list[_Image]] = {}
    for one in cubes or usable:
        groups.setdefault((one.index,) if cubes else (one.series, one.shape), []).append(one)
    found = _only([one for one in groups.values() if len(one) > 1]) or _only(list(groups.values()))
    if found is None or _is_doubtful(found, cubes or usable):
        several, what = (cubes, "cubes of frames") if cubes else (usable, "images")
        shown = ", ".join([one.label for one in several[:SHOWN]] + ["..."] * (len(several) > SHOWN))
        raise InputDataError(
            f"{path}: {len(several)} {what} that could each be the recording: {shown}; give each its own file"
        )
    return sorted(found, key=lambda one: one.number)


def _only(groups: list[list[_Image]]) -> list[_Image] | None:
    """The only one of several groups of images; else the only one that has a name of science images."""
    science = [group for group in groups if SCIENCE.fullmatch(group[0].series)]
    return next((choice[0] for choice in (groups, science) if len(choice) == 1), None)


def _is_doubtful(frames: list[_Image], choice: list[_Image]) -> bool:
    """Whether images are parts of a mosaic, or others of their name have another window."""
    others = [one for one in choice if one not in frames and one.index > 0 and one.series == frames[0].series]
    return bool(others) or (len(frames) > 1 and MOSAIC.fullmatch(frames[0].series) is not None)


def _unread(path: Path, images: list[_Image]) -> tuple[str, ...]:
    if not images:
        return ()
    counts = Counter(one.series or ("without a name" if one.index else "PRIMARY") for one in images)
    names = ", ".join(
        f"{printable(name)} ({count})" if count > 1 else printable(name) for name, count in counts.items()
    )
    return (f"{path}: images that are not read: {names}",)
