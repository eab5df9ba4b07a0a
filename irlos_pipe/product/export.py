"""Copy arrays out of a product into FITS or CSV, for people who do not read HDF5."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.product.header import Card, Origin, header_cards
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.results import Recorded, provenance_of, recorded
from irlos_pipe.product.table import ascii_text, csv_content, fits_content

NOLL = "noll"
MODAL = ("zernike_nm", "modes_nm", "offset_nm")  # arrays with one coefficient per Noll index


def export_arrays(product: Product, names: Sequence[str], path: Path, *, replace: bool = False) -> None:
    """Write the arrays `names` of a `product` to a ``.fits`` or ``.csv`` file at `path`, with a full header.

    FITS gets one extension per array (and one per error, named ``<array>_ERROR``) with its unit in
    BUNIT. CSV gets one column per array of one dimension, or the rows of one array of two; coefficients
    come with their Noll indices.

    Raises `ConfigurationError` when an array or the file type is unknown, the arrays do not fit into one
    table, or the file exists and `replace` is False.
    """
    writers = {".fits": _fits_bytes, ".csv": _csv_bytes}
    if path.suffix not in writers:
        raise ConfigurationError(f"{path}: unknown file type '{path.suffix}'; use .fits or .csv")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists already; choose another name or give --force")
    for name in names:
        if name not in product.arrays:
            raise ConfigurationError(f"no array '{name}' in this product{suggestion(name, product.arrays)}")
    write_bytes(path, writers[path.suffix](product, {name: product.arrays[name] for name in names}))


def _origin(product: Product) -> Origin:
    made = provenance_of(product)
    category = f"IRLOS_{product.stage.upper()}"
    seen = recorded(product.provenance)
    return Origin(product.stage, category, made, seen, product.checks, product.config, made.notice)


def _fits_bytes(product: Product, quantities: dict[str, Quantity]) -> bytes:
    origin = _origin(product)
    hdus = []
    for name, quantity in quantities.items():
        hdus.append(_hdu(name, quantity.value, quantity))
        if quantity.error is not None:
            hdus.append(_hdu(f"{name}_error", quantity.error, quantity))
    for hdu in hdus:
        _add_scale(hdu, origin.recordings)
    # As it was called before there were ESO's keywords.
    stage = Card("STAGE", product.stage, "irlos stage that made the arrays")
    return fits_content(hdus, [stage, *header_cards(origin)])


def _add_scale(hdu: fits.hdu.base.ExtensionHDU, recordings: Sequence[Recorded]) -> None:
    """Say where the pixels of an image lie: offsets from the centre of the window [mas]."""
    window = recordings[0].window if recordings else ()
    if not isinstance(hdu, fits.ImageHDU) or hdu.data.ndim < 2 or hdu.shape[-2:] != tuple(window):
        return
    for axis, name in ((1, "X"), (2, "Y")):
        hdu.header[f"CTYPE{axis}"] = (f"{name}OFFSET", "from the centre of the window")
        hdu.header[f"CUNIT{axis}"] = "mas"
        hdu.header[f"CRPIX{axis}"] = (hdu.shape[-axis] + 1) / 2
        hdu.header[f"CRVAL{axis}"] = 0.0
        hdu.header[f"CDELT{axis}"] = recordings[0].pixel_scale_mas


def _hdu(name: str, values: np.ndarray, quantity: Quantity) -> fits.hdu.base.ExtensionHDU:
    if values.dtype.kind == "U" or values.ndim == 0:
        hdu = fits.BinTableHDU.from_columns([_column(values)], name=name)
    else:
        # FITS images know no booleans.
        hdu = fits.ImageHDU(values.astype(np.uint8) if values.dtype == bool else values, name=name)
        hdu.header["BUNIT"] = quantity.unit
    hdu.header.add_comment(ascii_text(quantity.description))
    return hdu


def _column(values: np.ndarray) -> fits.Column:
    flat = np.char.encode(values.ravel(), "utf-8") if values.dtype.kind == "U" else values.ravel()
    code = {"b": "L", "i": "K", "u": "K", "f": "D"}.get(flat.dtype.kind, f"{max(flat.dtype.itemsize, 1)}A")
    return fits.Column(name="value", format=code, array=flat)


def _csv_bytes(product: Product, quantities: dict[str, Quantity]) -> bytes:
    columns = _columns(_with_indices(product, quantities))
    lengths = {len(column) for column in columns.values()}
    if len(lengths) > 1:
        raise ConfigurationError(
            f"arrays of different lengths ({', '.join(map(str, sorted(lengths)))}) "
            "do not fit into one table; export them one by one"
        )
    cells = (column.tolist() for column in columns.values())
    return csv_content(header_cards(_origin(product)), columns, cells)


def _with_indices(product: Product, quantities: dict[str, Quantity]) -> dict[str, Quantity]:
    """The arrays, behind the Noll indices of the coefficients among them."""
    nolls = product.arrays.get(NOLL)
    if nolls is None or NOLL in quantities:
        return quantities
    modal = any(name in MODAL and one.value.shape == nolls.value.shape for name, one in quantities.items())
    return {NOLL: nolls, **quantities} if modal else quantities


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
