"""Products as HDF5 files: written whole or not at all, read as a whole, by metadata, or array by array.

Layout of the file::

    /                attributes schema, schema_version, stage
    /arrays/<name>   one dataset per quantity, attributes unit and description
    /errors/<name>   1-sigma error of the quantity of the same name, where there is one
    /results         JSON: the stage's section of results.json
    /checks          JSON: list of QC checks
    /config          JSON: the resolved configuration of the stage
    /provenance      JSON: inputs, versions, host, times, key
    /log             one line per message

Nothing but ``provenance`` and ``log`` depends on when and where the file was made. Checksums and a copy of
everything but the arrays stand in front.
"""

import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import BaseModel

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.results import Provenance

HEAD_BYTES = 512  # in front of the data: the smallest user block of HDF5
MARK = b"irlos sha256 "
METADATA = b"metadata"
MAX_DEPTH = 20  # of groups in groups
MAX_COMPRESSION = 1100  # deflate reaches 1032 at most

SCHEMA = "irlos-product"
SCHEMA_VERSION = 1
COMPRESS_ABOVE_BYTES = 4096  # smaller arrays are stored as they are
SUFFIX = ".h5"


class Damaged(ValueError):
    """The content of a file does not fit its checksum."""

    def __init__(self) -> None:
        super().__init__("its content does not fit its checksum")


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
            if item.external or item.is_virtual:
                raise ValueError(f"the data of '{item.name}' are in another file")
            if item.nbytes > MAX_COMPRESSION * item.id.get_storage_size():
                raise ValueError(f"'{item.name}' announces {item.nbytes} bytes that are not stored")


class _Sections(BaseModel):
    """The JSON sections of the file."""

    results: dict[str, Any]
    checks: list[Check]
    config: dict[str, Any]
    provenance: Provenance
    log: list[str]


def write_product(product: Product, path: Path) -> None:
    """Write a `product` to `path` atomically.

    Raises `IrlosError` when the file cannot be written; an earlier file of that name is then unchanged.
    """
    checks = [check.as_dict() for check in product.checks]
    sections = {
        "results": product.results,
        "checks": checks,
        "config": product.config,
        "provenance": product.provenance,
        "log": product.log,
    }
    head = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "stage": product.stage}
    metadata = json_text(head | {"arrays": list(product.arrays)} | sections, indent=None).encode()
    # HDF5 builds the file in memory: it cannot recover from a disk that fills up half way.
    buffer = io.BytesIO()
    # The user block in front holds the metadata; HDF5 asks for a power of two.
    block_bytes = max(HEAD_BYTES, 1 << (HEAD_BYTES + len(metadata) - 1).bit_length())
    with h5py.File(buffer, "w", userblock_size=block_bytes) as file:
        file.attrs.update(head)
        for name, quantity in product.arrays.items():
            dataset = _write_array(file, f"arrays/{name}", np.asarray(quantity.value))
            dataset.attrs.update(unit=quantity.unit, description=quantity.description)
            if quantity.error is not None:
                _write_array(file, f"errors/{name}", np.asarray(quantity.error)).attrs["unit"] = quantity.unit
        for section, content in sections.items():
            file.create_dataset(section, data=json_text(content), track_times=False)
    seal(buffer.getbuffer(), metadata)
    write_bytes(Path(path), buffer.getbuffer())


def read_product(path: Path, *, arrays: bool = True) -> Product:
    """Read the product at `path`, without `arrays` only its metadata, which does not touch the rest.

    Strings come back as arrays of dtype ``str``.

    Raises `InputDataError` when the file is missing, truncated, not a product, or what is read of it is
    damaged.
    """
    with _readable(path):
        metadata = None if arrays else _front_metadata(path)
        return _read_hdf5(path, arrays) if metadata is None else _product(metadata, {})


def open_product(path: Path) -> Product:
    """Return the product at `path` with `StoredArrays`, which are read when they are asked for.

    Raises `InputDataError` when the file is missing, truncated or not a product, or its metadata are
    damaged.
    """
    with _readable(path):
        metadata = _front_metadata(path)
        if metadata is None:
            return _read_hdf5(path, arrays=True)
        return _product(metadata, StoredArrays(Path(path), metadata["arrays"]))


def is_intact(path: Path) -> bool:
    """Return whether the product at `path` is what was written, arrays and all."""
    try:
        with _readable(path):
            require_unchanged(path)
    except InputDataError:
        return False
    return True


class StoredArrays(Mapping[str, Quantity]):
    """The arrays `names` of the product file `path` with metadata in front, each read when asked for.

    Before the first is read, the file is compared with its checksum.
    """

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        self._path, self._names = path, dict.fromkeys(names)
        self._found: dict[str, Quantity] = {}

    def __getitem__(self, name: str) -> Quantity:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._found:
            with _readable(self._path):
                if not self._found:
                    require_unchanged(self._path)
                with _opened(self._path) as file:
                    if not self._found:
                        require_self_contained(file)
                    self._found[name] = _read_quantity(file, name)
        return self._found[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while a product is read into an `InputDataError`."""
    if not Path(path).is_file():
        raise InputDataError(f"{path}: no such product")
    try:
        yield
    except InputDataError:
        raise
    except Exception as error:  # a damaged file can raise nearly anything from inside HDF5
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        if path.suffix != SUFFIX:  # a file of somebody: nothing to remove
            raise InputDataError(
                f"{path}: not a product; those of a run are named like 02_calibrate{SUFFIX}"
            ) from error
        if isinstance(error, OSError) and error.errno:  # of the disk: the product may be good
            raise InputDataError(f"{path}: cannot be read: {reason}") from error
        raise InputDataError(
            f"{path}: not a readable product, truncated or damaged ({reason}); remove it and run again"
        ) from error


def _opened(path: Path) -> h5py.File:
    """A product is renamed into place when it is whole: it needs no lock, which many disks cannot give."""
    return h5py.File(path, "r", locking=False)


def _front_metadata(path: Path) -> dict[str, Any] | None:
    """Return the metadata in front of a file; None where there are none."""
    content = sealed_metadata(Path(path))
    if content is None:
        return None
    metadata = json.loads(content)
    _require_schema(metadata, path)
    return metadata


def _read_hdf5(path: Path, arrays: bool) -> Product:
    require_unchanged(Path(path))
    with _opened(path) as file:
        _require_schema(file.attrs, path)
        require_self_contained(file)
        sections = {name: json.loads(file[name].asstr()[()]) for name in _Sections.model_fields}
        found = _read_arrays(file) if arrays else {}
        return _product(sections | {"stage": str(file.attrs["stage"])}, found)


def _product(metadata: Mapping[str, Any], arrays: Mapping[str, Quantity]) -> Product:
    sections = {name: metadata[name] for name in _Sections.model_fields}
    checks = _Sections.model_validate(sections).checks
    return Product(metadata["stage"], arrays, **sections | {"checks": checks})


def _write_array(file: h5py.File, name: str, value: np.ndarray) -> h5py.Dataset:
    if value.dtype.kind in "OU":
        return file.create_dataset(
            name, data=value.astype(object), dtype=h5py.string_dtype(), track_times=False
        )
    options = {}
    if value.nbytes > COMPRESS_ABOVE_BYTES:
        options = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
    return file.create_dataset(name, data=value, track_times=False, **options)


def _require_schema(head: Mapping[str, Any], path: Path) -> None:
    if head.get("schema") != SCHEMA:
        raise InputDataError(f"{path}: an HDF5 file, but not a product of irlos")
    version = int(head["schema_version"])
    if version > SCHEMA_VERSION:
        raise InputDataError(
            f"{path}: product format {version} is newer than this software "
            f"({SCHEMA_VERSION}); update irlos_pipe or run again"
        )


def _read_arrays(file: h5py.File) -> dict[str, Quantity]:
    names: list[str] = []

    def visit(name: str, item: h5py.HLObject) -> None:
        names.extend([name] if isinstance(item, h5py.Dataset) else [])

    if "arrays" in file:
        file["arrays"].visititems(visit)
    return {name: _read_quantity(file, name) for name in names}


def _read_quantity(file: h5py.File, name: str) -> Quantity:
    dataset = file[f"arrays/{name}"]
    error = _read_array(file[f"errors/{name}"]) if f"errors/{name}" in file else None
    return Quantity(_read_array(dataset), dataset.attrs["unit"], dataset.attrs["description"], error)


def _read_array(dataset: h5py.Dataset) -> np.ndarray:
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return np.asarray(dataset.asstr()[()], dtype=str)
    return np.asarray(dataset[()])
