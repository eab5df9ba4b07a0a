"""What packers, archives, browsers and other people's software make of a recording on its way."""

import bz2
import gzip
import io
import lzma
from pathlib import Path

import numpy as np
from astropy.io import fits

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of
from fuzz.damage import damaged
from fuzz.tree_kinds import NIGHT_RECIPE

CARD, BLOCK = 80, 2880
PACKERS = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
NAMES = (
    "cube.fits", "cube.fits.gz", "cube.fits.bz2", "CUBE.FITS.FZ", "cube.fts", "cube.fits (1)",
    "cube(2).fit", "cube.fits.1", "cube.fits.xz", "cube.fits.Z", "cube.fits.zip",
)  # fmt: skip
CARDS = (
    "HIERARCH ESO TEL AMBI FWHM START = nan", "HIERARCH ESO TEL ALT = 60,5", "AIRMASS = -nan",
    "GAIN    = INF", "OBJECT  = HD 12345", "EXPTIME = 0,1 / s", "DATE-OBS= 2021-05-01T03:00:00",
    "MJD-OBS = 5.9E", "EXTNAME = SCI", "EXTVER  = one", "INHERIT = true", "CONTINUE  nothing",
    "LONG    = 'abc", "FILTER  =K", "HIERARCH ESO = = 3", "EXPTIME = 1.5d-3", "DATASUM = nan",
    "CHECKSUM= nan", "BSCALE  = nan", "BZERO   = 0,0", "BLANK   = -", "TELRA   = 12:34:56.7",
    "HISTORY = nan", "COMMENT ' \" / =", "RDNOISE = (1, 2", "ITIME   = 1e999", "key     = nan",
    "HIERARCH ESO SEQ NGS MAG = 7.0.1", "HIERARCH ESO DET NDIT = 1e300", "COADDS  = 3.5", "EGAIN   = 'x'",
    "UT      = nan",
)  # fmt: skip
ELSE = (
    b"<!DOCTYPE html><html>", b"<?xml version='1.0'?>", b"version https://git-lfs.github.com/spec/v1\n",
    b"", b"\0" * 2880, b"\xef\xbb\xbfSIMPLE  = T", b"PK\x03\x04", b"\x1f\x9d\x90", b"\x1f\x8b", b"BZh9",
    b"\xfd7zXZ\x00", b"XTENSION= 'IMAGE   '", b"SIMPLE  =                    F",
    b"../../.git/annex/objects/x",
)  # fmt: skip


@kind
def packed(folder: Path, rng: np.random.Generator) -> Case:
    """Pack a cube once or twice, under the name of another packer, and perhaps damage it."""
    content, how = _cube(folder), []
    if rng.random() < 0.4:
        content = _tiled(content, rng)
        how.append("tiles")
    for _ in range(rng.integers(0, 3)):
        name = pick(rng, list(PACKERS))
        at = int(rng.integers(1, len(content))) if rng.random() < 0.3 else len(content)
        content = b"".join(PACKERS[name](part) for part in (content[:at], content[at:]) if part)
        how.append(name)
    if rng.random() < 0.4:
        what, content = damaged(content, rng)
        how.append(what)
    name = pick(rng, list(NAMES))
    (folder / "in" / name).write_bytes(content)
    return Case(f"{name}: {', '.join(how)}", _command(folder, rng, name), "cube")


@kind
def cards(folder: Path, rng: np.random.Generator) -> Case:
    """Put cards into the header that break the standard."""
    chosen = [pick(rng, list(CARDS)) for _ in range(rng.integers(1, 4))]
    content = _with_cards(_cube(folder), chosen)
    (folder / "in" / "cube.fits").write_bytes(content)
    return Case(f"{chosen}", _command(folder, rng, "cube.fits"), "cube")


@kind
def extensions(folder: Path, rng: np.random.Generator) -> Case:
    """Spread the frames over extensions, with masks, previews and strangers among them."""
    _cube(folder)
    name = pick(rng, ["", "SCI", "FRAME{}", "CCD{}", "DATA", "ERR", "1", "{}A", "sci_{}"])
    number = pick(rng, [lambda i: i + 1, lambda i: 2 * i + 1, lambda i: 9 - i, lambda i: 1])
    images = [
        fits.ImageHDU(frame, name=name.format(number(i)), ver=number(i))
        for i, frame in enumerate(pristine.adu())
    ]
    if rng.random() < 0.2:
        images = [fits.ImageHDU(pristine.adu(), name=name)]
    others = [
        fits.ImageHDU(
            np.zeros((pristine.ROWS, pristine.COLUMNS), np.uint8), name=pick(rng, ["", "DQ", "SCI", "X"])
        ),
        fits.ImageHDU(pristine.adu()[0, ::3, ::3].copy(), name=pick(rng, ["", "PREVIEW", "SCI"])),
        fits.ImageHDU(np.abs(pristine.adu()), name=pick(rng, ["VAR", "STAT", "", "MODEL"])),
        fits.ImageHDU(np.arange(7.0), name="SPECTRUM"),
        fits.ImageHDU(name="SCI"),
    ]
    added = [others[i] for i in rng.permutation(len(others))[: rng.integers(0, 3)]]
    images = [*added, *images] if rng.random() < 0.5 else [*images, *added]
    primary = pick(rng, [None, None, pristine.adu()[0], pristine.adu()[0, :9, :9].copy()])
    fits.HDUList([fits.PrimaryHDU(primary), *images]).writeto(folder / "in" / "cube.fits", checksum=True)
    names = [image.name for image in images]
    return Case(f"{names}", _command(folder, rng, "cube.fits"), "cube")


@kind
def lone_sidecar(folder: Path, rng: np.random.Generator) -> Case:
    """Lose one of two recordings whose side-car stays, or leave something else in its place."""
    path = pristine.write("recorder", folder / "in" / "sky")
    pristine.write("recorder", folder / "in" / "other")
    instead = pick(
        rng, ["gone", ".part", ".crdownload", ".fits.part", ".fits.bz2.tmp", "renamed", "folder", "else"]
    )
    side = path.with_name("acquisition.yaml")
    if rng.random() < 0.5:
        side = side.rename(path.with_name(pick(rng, ["sky.yaml", "x.yaml", "sky.fits.yaml"])))
    if instead == "else":
        path.write_bytes(pick(rng, list(ELSE)))
    elif instead == "folder":
        path.unlink()
        path.mkdir()
    elif instead == "gone":
        path.unlink()
    else:
        path.rename(path.with_name(f"sky{instead}" if instead[0] == "." else "moved.dat"))
    if rng.random() < 0.3:
        side.write_bytes(
            pick(rng, [b"", b"\xff\xfe", b"role: [", b"role: ncpa_calibration", b"role: x", b"- 1\n"])
        )
    return Case(f"{side.name}: {instead}", _command(folder, rng, ""))


def _cube(folder: Path) -> bytes:
    """An unspoiled cube with checksums, whose side-car alone is written."""
    pristine.write("cube", folder / "in").unlink()
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(pristine.adu())]).writeto(stream, checksum=True)
    return stream.getvalue()


def _tiled(content: bytes, rng: np.random.Generator) -> bytes:
    """The cube in compressed tiles, with the checksums of the original as fpack leaves them."""
    (original,) = fits.open(io.BytesIO(content))
    how = pick(rng, ["RICE_1", "GZIP_1", "GZIP_2", "HCOMPRESS_1"])
    tiles = fits.CompImageHDU(np.rint(original.data).astype(np.int32), compression_type=how)
    for key in ("CHECKSUM", "DATASUM"):
        tiles.header[key] = original.header[key]
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(stream)
    return stream.getvalue()


def _with_cards(content: bytes, more: list[str]) -> bytes:
    end = next(at for at in range(0, len(content), CARD) if content[at : at + CARD].rstrip() == b"END")
    data = -(-(end + CARD) // BLOCK) * BLOCK
    header = content[:end] + b"".join(card.encode().ljust(CARD) for card in [*more, "END"])
    return header.ljust(-(-len(header) // BLOCK) * BLOCK) + content[data:]


def _command(folder: Path, rng: np.random.Generator, name: str) -> tuple[str, ...]:
    """Run, check, describe or plan it."""
    recipe = pristine.write_recipe(folder)
    output = ("--output", str(folder / "out"))
    if (draw := rng.random()) < 0.55:
        return run_of(folder)
    if draw < 0.7:
        return ("validate", str(recipe))
    if draw < 0.85 and name:
        return ("sidecar", str(folder / "in" / name), "--output", "-")
    night = folder / "night.yaml"
    night.write_text(NIGHT_RECIPE)
    return ("night", str(folder / "in"), *output, "--recipe", f"calibration={night}", "--dry-run", "-v")
