"""Checksums in front of an HDF5 file, and a look at whether all of the file is in the file.

HDF5 checks little of what it reads: a flipped bit in a small array or in a text comes back as if it
had been written so, and a damaged structure can bring it down. So nothing is read through HDF5 before
the file has been compared with its checksum. The checksum stands in the user block, which HDF5 leaves to
its users, so that any HDF5 software reads a sealed file. Behind it stands a copy of the metadata, with a
checksum of its own: reading it takes neither HDF5 nor the rest of the file.

Layout of the user block::

    irlos sha256 <of all from byte 512 on>
    metadata <bytes> <sha256> of <bytes of the file>
    (zeros up to byte 512, then the metadata, then zeros)

Files without checksum, made by others, and those of earlier versions, without metadata, are read as well.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import h5py

HEAD_BYTES = 512  # in front of the data: the smallest user block of HDF5
MARK = b"irlos sha256 "
METADATA = b"metadata"
MAX_DEPTH = 20  # of groups in groups
MAX_COMPRESSION = 1100  # deflate reaches 1032 at most


class Damaged(ValueError):
    """The content of a file does not fit its checksum."""

    def __init__(self) -> None:
        super().__init__("its content does not fit its checksum")


def block_bytes(metadata: bytes) -> int:
    """Return the size of the user block that holds `metadata`, a power of two as HDF5 asks for."""
    return max(HEAD_BYTES, 1 << (HEAD_BYTES + len(metadata) - 1).bit_length())


def seal(content: memoryview, metadata: bytes) -> None:
    """Write `metadata` and checksums into the user block of the `content` of an HDF5 file, in place."""
    content[HEAD_BYTES : HEAD_BYTES + len(metadata)] = metadata
    of_all, of_metadata = (hashlib.sha256(part).hexdigest() for part in (content[HEAD_BYTES:], metadata))
    lines = f"{of_all}\nmetadata {len(metadata)} {of_metadata} of {len(content)}\n"
    head = MARK + lines.encode()
    content[: len(head)] = head


def require_unchanged(path: Path) -> None:
    """Compare all of the file at `path` with its checksum; files without one pass.

    Raises `Damaged` when a single bit differs.
    """
    with open(path, "rb") as stream:
        line = stream.read(HEAD_BYTES).partition(b"\n")[0]
        if not line.startswith(MARK):
            return
        if line != MARK + hashlib.file_digest(stream, "sha256").hexdigest().encode():
            raise Damaged


def sealed_metadata(path: Path) -> bytes | None:
    """Return the metadata in front of the file at `path`; None for files that have none there.

    Raises `Damaged` when they differ from their checksum, or the file has another length.
    """
    with open(path, "rb") as stream:
        mark, line, *_ = [*stream.read(HEAD_BYTES).split(b"\n"), b""]
        if not mark.startswith(MARK) or not line.strip(b"\0"):
            return None
        try:
            name, size, sha256, _, length = line.split()
            metadata = stream.read(int(size))
            intact = (
                name == METADATA
                and path.stat().st_size == int(length)
                and hashlib.sha256(metadata).hexdigest().encode() == sha256
            )
        except ValueError:
            intact = False
    if not intact:
        raise Damaged
    return metadata


def require_self_contained(group: h5py.Group, depth: int = 0) -> None:
    """Refuse what in or below a `group`, itself `depth` deep, would read other files or fill the memory.

    Raises `ValueError` for a soft or external link, a group inside itself, data kept in another file, or an
    array announced but not stored.
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
