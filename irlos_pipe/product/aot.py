"""Recordings as Adaptive Optics Telemetry (AOT) files, written through the optional package aotpy."""

from __future__ import annotations

import json
import tempfile
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import Recorded, recorded

ROOT = "recordings"
ARRAYS = (
    "raw_adu", "background_adu", "flat", "pixel_mask", "time_s", "frame_counter", "start_unix_s",
)  # fmt: skip
SAME_KEYS = (
    "role", "target", "mag_j", "exposure_s", "frame_rate_hz", "pixel_scale_mas", "seeing_arcsec",
    "derotator_angle_deg", "parallactic_angle_deg", "altitude_deg", "zenith_angle_deg", "pressure_hpa",
    "temperature_c", "humidity_percent", "dispersion_corrected", "filter", "pupil_rotation_deg",
)  # fmt: skip


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
    prefix = _prefix(product, name)
    made_from = {f"{ROOT}/{one.input}/{one.name}": one for one in recorded(product.provenance)}
    seen = made_from.get(prefix, Recorded())
    content = _content(product, prefix, seen)
    write_bytes(sidecar, yaml_text(_sidecar(product, prefix)).encode())
    write_bytes(path, content)


def _prefix(product: Product, name: str) -> str:
    """Where the arrays of a recording lie."""
    known = sorted({array.rpartition("/")[0] for array in product.arrays if array.endswith("/raw_adu")})
    if not known:
        raise ConfigurationError(
            f"stage '{product.stage}': its product holds no recordings; give 01_ingest.h5"
        )
    fitting = [one for one in known if one == f"{ROOT}/{name}" or one.split("/", 2)[-1] == name]
    if len(fitting) != 1:
        names = [one.removeprefix(f"{ROOT}/") for one in known]
        raise ConfigurationError(f"--recording {name}: not one of this product{suggestion(name, names)}")
    return fitting[0]


def _content(product: Product, prefix: str, seen: Recorded) -> bytes:
    aotpy = _aotpy()
    values = {
        key: np.asarray(product.arrays[f"{prefix}/{key}"].value)
        for key in (
            "raw_adu",
            "background_adu",
            "flat",
            "pixel_mask",
            "time_s",
            "frame_counter",
            "start_unix_s",
        )
    }
    acquisition = json.loads(str(product.arrays[f"{prefix}/acquisition"].value))
    start_s = float(values["start_unix_s"])
    times = (start_s + values["time_s"]).tolist() if np.isfinite(start_s) else []
    time = aotpy.Time(uid="frames", timestamps=times, frame_numbers=values["frame_counter"].tolist())
    detector = aotpy.Detector(
        uid=(seen.instrument or "camera").upper(),
        pixel_intensities=aotpy.Image("frames", values["raw_adu"], unit="adu", time=time),
        pixel_scale=acquisition["pixel_scale_mas"] * MAS,
        integration_time=acquisition["exposure_s"],
        frame_rate=acquisition["frame_rate_hz"],
        excess_noise=acquisition["detector"]["excess_noise_factor"],
        dark=aotpy.Image("dark", values["background_adu"].astype(np.float32), unit="adu"),
        flat_field=aotpy.Image("flat", _inverse(values["flat"])),
        bad_pixel_map=aotpy.Image("bad", (~values["pixel_mask"].astype(bool)).astype(np.uint8)),
    )
    return _file(_system(aotpy, detector, acquisition, seen, start_s))


def _system(aotpy: Any, detector: Any, acquisition: dict[str, Any], seen: Recorded, start_s: float) -> Any:
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
    return system


def _inverse(flat: np.ndarray) -> np.ndarray:
    return np.divide(1, flat, out=np.zeros(flat.shape, np.float32), where=flat > 0)


def _file(system: Any) -> bytes:
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


def _aotpy() -> Any:
    try:
        import aotpy
    except ImportError:
        raise ConfigurationError(
            "AOT files need the package aotpy; install it with: pip install aotpy"
        ) from None
    return aotpy
