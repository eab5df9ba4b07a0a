"""Copy arrays out of a product into FITS or CSV, for people who do not read HDF5."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.product.product import Product, Quantity


def export_arrays(product: Product, names: Sequence[str], path: Path, *, replace: bool = False) -> None:
    """Write arrays of a product to a ``.fits`` or ``.csv`` file.

    FITS gets one extension per array (and one per error, named ``<array>_ERROR``) with its unit in
    BUNIT. CSV gets one column per array of one dimension, or the rows of one array of two.

    Parameters
    ----------
    product : Product
        Read with its arrays.
    names : sequence of str
        Names of the arrays.
    path : Path
        The file; its suffix is the format.
    replace : bool
        Whether an existing file is replaced.

    Raises
    ------
    ConfigurationError
        When an array or the file type is unknown, the arrays do not fit into one table, or the
        file exists and `replace` is False.
    """
    writers = {".fits": _fits_bytes, ".csv": _csv_bytes}
    if path.suffix not in writers:
        raise ConfigurationError(f"{path}: unknown file type '{path.suffix}'; use .fits or .csv")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists already; choose another name or give --force")
    for name in names:
        if name not in product.arrays:
            raise ConfigurationError(f"no array '{name}' in this product{suggestion(name, product.arrays)}")
    write_bytes(path, writers[path.suffix](product.stage, {name: product.arrays[name] for name in names}))


def _fits_bytes(stage: str, quantities: dict[str, Quantity]) -> bytes:
    primary = fits.PrimaryHDU()
    primary.header["STAGE"] = (stage, "irlos stage that made the arrays")
    hdus = [primary]
    for name, quantity in quantities.items():
        hdus.append(_hdu(name, quantity.value, quantity))
        if quantity.error is not None:
            hdus.append(_hdu(f"{name}_error", quantity.error, quantity))
    stream = io.BytesIO()
    fits.HDUList(hdus).writeto(stream)
    return stream.getvalue()


def _hdu(name: str, values: np.ndarray, quantity: Quantity) -> fits.hdu.base.ExtensionHDU:
    if values.dtype.kind == "U" or values.ndim == 0:
        hdu = fits.BinTableHDU.from_columns([_column(values)], name=name)
    else:
        # FITS images know no booleans.
        hdu = fits.ImageHDU(values.astype(np.uint8) if values.dtype == bool else values, name=name)
        hdu.header["BUNIT"] = quantity.unit
    hdu.header.add_comment(quantity.description.encode("ascii", "replace").decode())
    return hdu


def _column(values: np.ndarray) -> fits.Column:
    flat = np.char.encode(values.ravel(), "utf-8") if values.dtype.kind == "U" else values.ravel()
    code = {"b": "L", "i": "K", "u": "K", "f": "D"}.get(flat.dtype.kind, f"{max(flat.dtype.itemsize, 1)}A")
    return fits.Column(name="value", format=code, array=flat)


def _csv_bytes(stage: str, quantities: dict[str, Quantity]) -> bytes:
    columns = _columns(quantities)
    lengths = {len(column) for column in columns.values()}
    if len(lengths) > 1:
        raise ConfigurationError(
            f"arrays of different lengths ({', '.join(map(str, sorted(lengths)))}) "
            "do not fit into one table; export them one by one"
        )
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    return stream.getvalue().encode()


def _columns(quantities: dict[str, Quantity]) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    for name, quantity in quantities.items():
        columns |= _as_columns(name, quantity.unit, quantity.value)
        if quantity.error is not None:
            columns |= _as_columns(f"{name}_error", quantity.unit, quantity.error)
    return columns


def _as_columns(name: str, unit: str, values: np.ndarray) -> dict[str, np.ndarray]:
    if values.ndim > 2:
        raise ConfigurationError(f"array '{name}' has {values.ndim} dimensions and CSV holds two; use .fits")
    suffix = f" [{unit}]" if unit else ""
    if values.ndim < 2:
        return {f"{name}{suffix}": np.atleast_1d(values)}
    return {f"{name} {index}{suffix}": values[:, index] for index in range(values.shape[1])}
