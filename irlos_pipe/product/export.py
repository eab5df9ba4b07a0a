"""Copy arrays out of a product into FITS or CSV, for people who do not read HDF5."""

import json
import tempfile
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.results import Recorded, provenance_of, recorded
from irlos_pipe.product.table import Card, Origin, ascii_text, csv_content, fits_content, header_cards

aotpy = LateModule(
    "aotpy", ConfigurationError("AOT files need the package aotpy; install it with: pip install aotpy")
)
NOLL = "noll"
MODAL = ("zernike_nm", "modes_nm", "offset_nm")  # arrays with one coefficient per Noll index

ROOT = "recordings"
ARRAYS = (
    "raw_adu", "background_adu", "flat", "pixel_mask", "time_s", "frame_counter", "start_unix_s",
)  # fmt: skip
SAME_KEYS = (
    "role", "target", "mag_j", "exposure_s", "frame_rate_hz", "pixel_scale_mas", "seeing_arcsec",
    "derotator_angle_deg", "parallactic_angle_deg", "altitude_deg", "zenith_angle_deg", "pressure_hpa",
    "temperature_c", "humidity_percent", "dispersion_corrected", "filter", "pupil_rotation_deg",
)  # fmt: skip


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
        flat = np.char.encode(values.ravel(), "utf-8") if values.dtype.kind == "U" else values.ravel()
        code = {"b": "L", "i": "K", "u": "K", "f": "D"}.get(
            flat.dtype.kind, f"{max(flat.dtype.itemsize, 1)}A"
        )
        hdu = fits.BinTableHDU.from_columns([fits.Column(name="value", format=code, array=flat)], name=name)
    else:
        # FITS images know no booleans.
        hdu = fits.ImageHDU(values.astype(np.uint8) if values.dtype == bool else values, name=name)
        hdu.header["BUNIT"] = quantity.unit
    hdu.header.add_comment(ascii_text(quantity.description))
    return hdu


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


def write_aot(product: Product, name: str, path: Path, *, replace: bool = False) -> None:
    """Write the recording `name` of an ingest `product` as an AOT file at `path`, as it was recorded.

    Raw counts with times and frame numbers, the background as it was subtracted, the flat as the standard
    has it (the inverse of the response) and the map of bad pixels: the readers of this package take the same
    recording from it. What the standard has no place for (spectrum, diversity, role) is written to a side-car
    next to it, ``<stem>.yaml``. The name is ``INPUT/RECORDING``, or the recording alone where that is unique.

    Raises `ConfigurationError` without aotpy, for an unknown recording or another product, or when a file
    exists and `replace` is False.
    """
    if path.suffix != ".fits":
        raise ConfigurationError(f"{path}: an AOT file ends in .fits")
    sidecar = path.with_suffix(".yaml")
    for file in (path, sidecar):
        if file.exists() and not replace:
            raise ConfigurationError(f"{file}: exists already; choose another name or give --force")
    known = sorted({array.rpartition("/")[0] for array in product.arrays if array.endswith("/raw_adu")})
    if not known:
        raise ConfigurationError(
            f"stage '{product.stage}': its product holds no recordings; give 01_ingest.h5"
        )
    fitting = [one for one in known if one == f"{ROOT}/{name}" or one.split("/", 2)[-1] == name]
    if len(fitting) != 1:
        names = [one.removeprefix(f"{ROOT}/") for one in known]
        raise ConfigurationError(f"--recording {name}: not one of this product{suggestion(name, names)}")
    prefix = fitting[0]
    made_from = {f"{ROOT}/{one.input}/{one.name}": one for one in recorded(product.provenance)}
    seen = made_from.get(prefix, Recorded())
    content = _content(product, prefix, seen)
    write_bytes(sidecar, yaml_text(_sidecar(product, prefix)).encode())
    write_bytes(path, content)


def _content(product: Product, prefix: str, seen: Recorded) -> bytes:
    values = {key: np.asarray(product.arrays[f"{prefix}/{key}"].value) for key in ARRAYS}
    acquisition = json.loads(str(product.arrays[f"{prefix}/acquisition"].value))
    start_s = float(values["start_unix_s"])
    times = (start_s + values["time_s"]).tolist() if np.isfinite(start_s) else []
    flat = values["flat"]
    response = np.divide(1, flat, out=np.zeros(flat.shape, np.float32), where=flat > 0)
    time = aotpy.Time(uid="frames", timestamps=times, frame_numbers=values["frame_counter"].tolist())
    detector = aotpy.Detector(
        uid=(seen.instrument or "camera").upper(),
        pixel_intensities=aotpy.Image("frames", values["raw_adu"], unit="adu", time=time),
        pixel_scale=acquisition["pixel_scale_mas"] * MAS,
        integration_time=acquisition["exposure_s"],
        frame_rate=acquisition["frame_rate_hz"],
        excess_noise=acquisition["detector"]["excess_noise_factor"],
        dark=aotpy.Image("dark", values["background_adu"].astype(np.float32), unit="adu"),
        flat_field=aotpy.Image("flat", response),
        bad_pixel_map=aotpy.Image("bad", (~values["pixel_mask"].astype(bool)).astype(np.uint8)),
    )
    system = aotpy.AOSystem(ao_mode="LTAO", name=str(seen.cards.get("INSTRUME", seen.instrument)))
    system.main_telescope = aotpy.MainTelescope(uid=str(seen.cards.get("TELESCOP", "telescope")))
    if np.isfinite(start_s):
        system.date_beginning = datetime.fromtimestamp(start_s, UTC).replace(tzinfo=None)
    source = aotpy.NaturalGuideStar(uid=acquisition["target"] or "star")
    wavelengths, weights = np.array(acquisition["spectrum"], float).T
    wavelength_m = float(np.average(wavelengths, weights=weights)) * NM
    camera = aotpy.ScoringCamera(uid="IRLOS", detector=detector, wavelength=wavelength_m)
    system.sources.append(source)
    system.scoring_cameras.append(camera)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # aotpy warns of every table that is empty
        path = Path(folder) / "aot.fits"
        system.write_to_file(path)
        return path.read_bytes()


def _sidecar(product: Product, prefix: str) -> dict[str, Any]:
    """The keys of a side-car, as far as they are known."""
    told = json.loads(str(product.arrays[f"{prefix}/acquisition"].value))
    defocus = np.asarray(product.arrays[f"{prefix}/introduced_defocus_nm"].value, float)
    keys = {name: told[name] for name in SAME_KEYS if told.get(name) not in (None, "")}
    return keys | {
        "spectrum": [{"wavelength_nm": nm, "weight": weight} for nm, weight in told["spectrum"]],
        "diversity": {
            "source": told["diversity_source"],
            "zernike": {int(noll): nm for noll, nm in told["diversity"].items()},
        },
        "introduced_defocus_nm": float(defocus[0]) if np.ptp(defocus) == 0 else defocus.tolist(),
        "detector": _detector_keys(told["detector"], told["exposure_s"]),
    }


def _detector_keys(detector: dict[str, Any], exposure_s: float | None) -> dict[str, float]:
    """The constants of one read, of which a frame is the sum; all light of the background as dark current."""
    reads = detector.get("reads", 1)
    keys = {
        "e_per_adu": detector["e_per_adu"],
        "read_noise_e": detector["read_noise_e"] / reads**0.5,
        "excess_noise_factor": detector["excess_noise_factor"],
    }
    if detector["saturation_adu"] is not None:
        keys["saturation_adu"] = detector["saturation_adu"] / reads
    if reads > 1:
        keys["coadds"] = reads
    if exposure_s and detector.get("background_e"):
        keys["dark_e_per_s"] = detector["background_e"] / exposure_s
    return keys
