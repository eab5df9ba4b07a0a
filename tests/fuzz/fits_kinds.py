"""Recordings: damaged bytes, absurd header values, turned axes, impossible pixels, bombs."""

import io
import itertools
from pathlib import Path

import numpy as np
from astropy.io import fits

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of
from fuzz.damage import damaged

CARD, BLOCK = 80, 2880
ABSURD = (
    "-1", "0", "1", "2", "3", "7", "16", "-64", "999", "2147483647", "2147483648", "9223372036854775807",
    "18446744073709551616", "1000000000000", "1E308", "-1E-308", "1E999", "NaN", "T", "F", "''", "'x'",
    "'../../../etc/passwd'", "'" + "9" * 60 + "E'", "'1PE(9)'", "'0E'", "'576X'", "'480D'", "'480A'",
    "(1.0, 2.0)", "0x10", "'no end", "", "/ only a comment", "\xff\xfe",
)  # fmt: skip
ABSURD_KEYS = (
    "BSCALE", "BZERO", "BLANK", "ZIMAGE", "THEAP", "GROUPS", "EXTEND", "NAXIS4", "NAXIS999", "CONTINUE",
    "INHERIT", "TDIM4", "TSCAL4", "TZERO4", "TNULL4", "DATASUM", "CHECKSUM",
)  # fmt: skip
# A file with these values is as good as one with others.
VALUE_KEYS = ("BSCALE", "BZERO", "TSCAL", "TZERO", "BLANK", "TNULL", "ESO", "HIERARCH", "OBJECT", "DATE")


@kind
def recording_bytes(folder: Path, rng: np.random.Generator) -> Case:
    """Damage the bytes of a data file."""
    name, path = _some_recording(folder, rng)
    how, content = damaged(path.read_bytes(), rng)
    path.write_bytes(content)
    return _ingested(folder, f"{name}: {how}", name)


@kind
def recording_header(folder: Path, rng: np.random.Generator) -> Case:
    """Give keys of the headers absurd values."""
    name, path = _some_recording(folder, rng)
    content = bytearray(path.read_bytes())
    cards = [_spoil_card(content, rng) for _ in range(rng.integers(1, 4))]
    path.write_bytes(content)
    plausible = any(card.startswith(VALUE_KEYS) for card in cards)
    return _ingested(folder, f"{name}: {', '.join(cards)}", name, plausible)


@kind
def calibration_map(folder: Path, rng: np.random.Generator) -> Case:
    """Damage a calibration image, or give it another shape or impossible values."""
    pristine.write("recorder", folder / "in" / "sky")
    which = pick(rng, ["DARK", "BACKGROUND", "FLAT", "DEAD", "WEIGHT"])
    path = folder / "in" / "sky" / f"IRAcq.DET1.{which}.fits"
    fits.writeto(path, _odd_map(rng), overwrite=True)
    if rng.random() < 0.5:
        path.write_bytes(damaged(path.read_bytes(), rng)[1])
    return _ingested(folder, f"map {which}")


@kind
def cube_axes(folder: Path, rng: np.random.Generator) -> Case:
    """Turn the axes of a cube, or add some."""
    path = pristine.write("cube", folder / "in")
    order = pick(rng, list(itertools.permutations(range(3)))[1:])
    cube = pristine.adu().transpose(order)
    extra = pick(rng, [(), (), (0,), (0, 1), (3,)])
    fits.writeto(path, np.expand_dims(cube, extra), overwrite=True)
    turned_window = order == (0, 2, 1)  # an image of a star, as good as the other
    return _ingested(folder, f"axes {order}, {len(extra)} more", "cube", turned_window)


@kind
def cube_values(folder: Path, rng: np.random.Generator) -> Case:
    """Fill pixels, frames or all of a cube with impossible values, or change its type."""
    path = pristine.write("cube", folder / "in")
    cube = pristine.adu().copy()
    place = pick(rng, [np.s_[:], np.s_[3], np.s_[:, 5], np.s_[:, 3, 4], np.s_[2, 9, 11], np.s_[::2]])
    value = pick(rng, [np.nan, np.inf, -np.inf, 0, -1e30, 3e38, 65535, 1e-40])
    cube[place] = value
    kind_of = pick(rng, ["f4", "f8", "i2", "u2", "u1", "i4", "i8"])
    with np.errstate(all="ignore"):
        fits.writeto(
            path, np.nan_to_num(cube).astype(kind_of) if kind_of[0] in "iu" else cube, overwrite=True
        )
    return _ingested(folder, f"{value} at {place} as {kind_of}", "cube")


@kind
def compressed(folder: Path, rng: np.random.Generator) -> Case:
    """Damage a cube in compressed tiles, or let its header announce more than they hold."""
    path = pristine.write("cube", folder / "in")
    how = pick(rng, [_tile_bomb, _damaged_tiles])
    summary = how(path, rng)
    return _ingested(folder, summary, "cube")


@kind
def table_layout(folder: Path, rng: np.random.Generator) -> Case:
    """Change what the columns of the pixel table say: windows, counters, times."""
    path = pristine.write("recorder", folder / "in" / "sky")
    with fits.open(path, mode="update") as hdus:
        column = pick(rng, ["FrameCounter", "WindowSizeX", "WindowSizeY", "Seconds", "USeconds"])
        rows = pick(rng, [np.s_[:], np.s_[3], np.s_[4:]])
        value = pick(rng, [0, -1, 1, 5, 21, 2**31 - 1, -(2**31)])
        hdus[1].data[column][rows] = value
    return _ingested(folder, f"{column}[{rows}] = {value}", "recorder")


def _some_recording(folder: Path, rng: np.random.Generator) -> tuple[str, Path]:
    name = pick(rng, ["recorder", "recorder", "cube", "muse"])
    return name, pristine.write(name, folder / "in" / "sky")


def _ingested(folder: Path, summary: str, reference: str = "", plausible: bool = False) -> Case:
    return Case(summary, run_of(folder, recipe=pristine.write_recipe(folder)), reference, plausible)


def _spoil_card(content: bytearray, rng: np.random.Generator) -> str:
    """Give a card of some header an absurd value; returns key and value."""
    places = [place for place in range(0, len(content), CARD) if _is_card(content[place : place + CARD])]
    place = int(pick(rng, places))
    key = bytes(content[place : place + 8]).decode().strip()
    if rng.random() < 0.25:
        key = pick(rng, list(ABSURD_KEYS))
    value = pick(rng, list(ABSURD))
    content[place : place + CARD] = f"{key:<8}= {value:>20}".encode("latin-1")[:CARD].ljust(CARD)
    return f"{key} = {value}"


def _is_card(card: bytes) -> bool:
    return card[8:10] == b"= " and card[:8].strip().replace(b"-", b"").replace(b"_", b"").isalnum()


def _odd_map(rng: np.random.Generator) -> np.ndarray:
    rows, columns = pristine.ROWS, pristine.COLUMNS
    shape = pick(
        rng,
        [(rows, columns), (columns, rows), (rows * columns,), (3, rows, columns), (1, 1), (rows, columns, 2)],
    )
    value = pick(rng, [0.0, 1.0, 50.0, -1.0, np.nan, np.inf, 1e30])
    return np.full(
        shape, value, pick(rng, ["f4", "f8", "i2"]) if np.isfinite(value) and value < 100 else "f4"
    )


def _tile_bomb(path: Path, rng: np.random.Generator) -> str:
    """A tile-compressed image whose header announces more pixels than its tiles hold."""
    content = bytearray(_tiled())
    axis = pick(rng, ["ZNAXIS1", "ZNAXIS2", "ZNAXIS3", "ZTILE1", "ZTILE2"])
    size = 10 ** int(rng.integers(4, 12))
    place = content.index(f"{axis:<8}= ".encode())
    content[place : place + CARD] = f"{axis:<8}= {size:>20}".ljust(CARD).encode()
    path.write_bytes(content)
    return f"tiles: {axis} = {size}"


def _damaged_tiles(path: Path, rng: np.random.Generator) -> str:
    how, content = damaged(_tiled(), rng)
    path.write_bytes(content)
    return f"tiles: {how}"


def _tiled() -> bytes:
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(pristine.adu().astype(np.int32))]).writeto(stream)
    return stream.getvalue()
