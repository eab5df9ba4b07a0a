"""A checksum in front of an HDF5 file, and a look at whether all of the file is in the file.

HDF5 checks little of what it reads: a flipped bit in a small array or in a text comes back as if it
had been written so. The checksum stands in the user block, which HDF5 leaves to its users, so that any
HDF5 software reads a sealed file.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import h5py

BLOCK_BYTES = 512  # the smallest user block
MARK = b"irlos sha256 "
MAX_DEPTH = 20
MAX_COMPRESSION = 1100  # deflate makes no more of less


def seal(content: memoryview) -> None:
    """Write the checksum of an HDF5 file into its user block, in place."""
    line = MARK + hashlib.sha256(content[BLOCK_BYTES:]).hexdigest().encode() + b"\n"
    content[: len(line)] = line


def require_unchanged(path: Path) -> None:
    """Compare a file with its checksum; files without one, made by others or long ago, pass.

    Raises
    ------
    ValueError
        When a single bit differs.
    """
    with open(path, "rb") as stream:
        line = stream.read(BLOCK_BYTES).partition(b"\n")[0]
        if not line.startswith(MARK):
            return
        if line != MARK + hashlib.file_digest(stream, "sha256").hexdigest().encode():
            raise ValueError("its content does not fit its checksum")


def require_self_contained(group: h5py.Group, depth: int = 0) -> None:
    """Refuse what would read other files, or fill the memory with what is not stored.

    Raises
    ------
    ValueError
        A soft or external link, a group inside itself, data kept in another file, or an array
        announced but not stored.
    """
    if depth > MAX_DEPTH:
        raise ValueError(f"groups are nested more than {MAX_DEPTH} deep")
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"'{name}' is a link to elsewhere")
        item = group[name]
        if isinstance(item, h5py.Group):
            require_self_contained(item, depth + 1)
        elif isinstance(item, h5py.Dataset):
            _require_stored(item)


def _require_stored(dataset: h5py.Dataset) -> None:
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"the data of '{dataset.name}' are in another file")
    if dataset.nbytes > MAX_COMPRESSION * dataset.id.get_storage_size():
        raise ValueError(f"'{dataset.name}' announces {dataset.nbytes} bytes that are not stored")
