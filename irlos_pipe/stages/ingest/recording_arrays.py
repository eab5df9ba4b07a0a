"""Recordings as arrays of the ingest product, and back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.blocks import mean_frame, picked
from irlos_pipe.frames.cleaning import Cleaned
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.results import results_of
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.stages.ingest.results import IngestResults

ROOT = "recordings"
# attribute: unit and description of its array
STORED = {
    "images_e": ("e-", "signal above background (frame, y, x)"),
    "used": ("", "frame is used"),
    "reason": ("", "why a frame is not used"),
    "good": ("", "pixel is good (y, x)"),
    "time_s": ("s", "time since the first frame"),
    "frame_counter": ("", "counter of the recorder"),
    "introduced_defocus_nm": ("nm", "introduced defocus, RMS"),
    "background_variance_e2": ("e-2", "variance per pixel beyond read noise and photons of the star"),
    "dark_variance_e2": ("e-2", "variance per pixel of the dark image, the same in every frame"),
    "frames_missing": ("", "frames the recorder lost"),
    "start_unix_s": ("s", "time of the first frame since 1970"),
}
ARRAYS = {name: name for name in STORED} | {"good": "pixel_mask"}  # as they are called in the product
LATER = ("dark_variance_e2",)  # products of ingest's first version have none
SCALARS = {
    "background_variance_e2": float,
    "dark_variance_e2": float,
    "frames_missing": int,
    "start_unix_s": float,
}


@dataclass(frozen=True)
class Overview:
    """What a report shows of a recording: all but its frames.

    Attributes
    ----------
    name, input, acquisition, good, start_unix_s
        See `Recording`.
    mean_e : ndarray, (rows, columns)
        Mean of the used frames [e-].
    """

    name: str
    input: str
    acquisition: Acquisition
    good: np.ndarray
    start_unix_s: float
    mean_e: np.ndarray


def prefix_of(recording: Recording) -> str:
    """Return where a recording lies in the product: ``recordings/<input>/<name>``."""
    return f"{ROOT}/{recording.input}/{recording.name}"


def arrays_from_recording(recording: Recording) -> dict[str, Quantity]:
    """Return everything that a recording holds, and the mean of its frames, as arrays of the product."""
    prefix = prefix_of(recording)
    arrays = {
        f"{prefix}/{ARRAYS[name]}": Quantity(np.asarray(getattr(recording, name)), unit, description)
        for name, (unit, description) in STORED.items()
    }
    acquisition = np.asarray(json.dumps(asdict(recording.acquisition), sort_keys=True), dtype=object)
    return arrays | {
        f"{prefix}/acquisition": Quantity(
            acquisition, "", "how it was taken, and where each key came from (JSON)"
        ),
        f"{prefix}/mean_e": Quantity(recording.mean_e, "e-", "mean of the used frames (y, x)"),
    }


def arrays_of(recording: Recording, cleaned: Cleaned, raw: RawRecording) -> dict[str, Quantity]:
    """Return all arrays that ingest leaves of a recording.

    Parameters
    ----------
    recording : Recording
        Its clean frames.
    cleaned : Cleaned
        What was found on the way.
    raw : RawRecording
        What it was made from.
    """
    prefix, background = prefix_of(recording), cleaned.background
    hits = np.stack([cleaned.hits.frame, cleaned.hits.row, cleaned.hits.column], axis=1)
    return arrays_from_recording(recording) | {
        f"{prefix}/raw_adu": Quantity(raw.adu, "ADU", "counts as recorded (frame, y, x)"),
        f"{prefix}/background_adu": Quantity(background.adu, "ADU", "subtracted from the counts (y, x)"),
        f"{prefix}/flat": Quantity(background.flat, "", "relative response, divided out (y, x)"),
        f"{prefix}/cosmic_hits": Quantity(hits, "", "replaced pixels: frame, row, column"),
        f"{prefix}/screened_e": Quantity(
            _screened_e(recording, cleaned, raw),
            "e-",
            "mean signal of the pixels in bad_pixels_found, as they were recorded",
        ),
    }


def found_bad(recording: Recording, raw: RawRecording) -> np.ndarray:
    """Return the bad pixels of a `recording` that no map of dead pixels of `raw` lists, (pixels, 2)."""
    listed = raw.calibration.bad
    found = ~recording.good if listed is None else ~recording.good & ~np.asarray(listed, bool)
    return np.argwhere(found)


def screened_e(product: Product, recording: Recording) -> dict[tuple[int, int], float]:
    """Return what the bad pixels that ingest found had shown, as (row, column): mean signal [e-].

    Parameters
    ----------
    product : Product
        Of ingest.
    recording : Recording
        One of its recordings.

    Raises
    ------
    InputDataError
        When the product is of an earlier version, which did not keep them.
    """
    rows = results_of(IngestResults, product).inputs
    row = next(row for row in rows if (row.input, row.name) == (recording.input, recording.name))
    if not row.bad_pixels_found:
        return {}
    name = f"{prefix_of(recording)}/screened_e"
    if name not in product.arrays:
        raise InputDataError(f"the {product.stage} product was made by an earlier version; run ingest again")
    return dict(zip(row.bad_pixels_found, product.arrays[name].value.tolist(), strict=True))


def recordings_from_product(product: Product, input: str | None = None) -> list[Recording]:
    """Return the recordings of an ingest product, in the order in which they were read.

    Parameters
    ----------
    product : Product
        Of ingest.
    input : str, optional
        Only those of this recipe input.

    Raises
    ------
    InputDataError
        When there are none.
    """
    recordings = [_recording(product, *key) for key in _keys(product) if input in (None, key[0])]
    if not recordings:
        of_input = "" if input is None else f" of input '{input}'"
        raise InputDataError(f"the {product.stage} product has no recordings{of_input}")
    return recordings


def overviews_from_product(product: Product) -> list[Overview]:
    """Return what a report shows of the recordings of an ingest product; frames are not read."""
    return [_overview(product, *key) for key in _keys(product)]


def _keys(product: Product) -> list[tuple[str, str]]:
    """Input and name of every recording, as listed in the results, others behind."""
    listed = [(row.input, row.name) for row in results_of(IngestResults, product).inputs]
    stored = sorted(set(_stored_keys(product)))
    return [key for key in listed if key in stored] + [key for key in stored if key not in listed]


def _stored_keys(product: Product) -> Iterator[tuple[str, str]]:
    for path in product.arrays:
        root, _, rest = path.partition("/")
        if root == ROOT and rest.endswith("/images_e"):
            owner, name = rest.removesuffix("/images_e").split("/", 1)
            yield owner, name


def _recording(product: Product, owner: str, name: str) -> Recording:
    prefix = f"{ROOT}/{owner}/{name}"
    stored: dict[str, Any] = {
        name: product.arrays[f"{prefix}/{array}"].value
        for name, array in ARRAYS.items()
        if name not in LATER or f"{prefix}/{array}" in product.arrays
    }
    stored |= {key: kind(stored[key]) for key, kind in SCALARS.items() if key in stored}
    return Recording(name=name, input=owner, acquisition=_acquisition(product, prefix), **stored)


def _overview(product: Product, owner: str, name: str) -> Overview:
    prefix = f"{ROOT}/{owner}/{name}"
    # products of earlier versions have no mean
    mean = product.arrays.get(f"{prefix}/mean_e")
    return Overview(
        name,
        owner,
        _acquisition(product, prefix),
        product.arrays[f"{prefix}/pixel_mask"].value,
        float(product.arrays[f"{prefix}/start_unix_s"].value),
        _recording(product, owner, name).mean_e if mean is None else mean.value,
    )


def _screened_e(recording: Recording, cleaned: Cleaned, raw: RawRecording) -> np.ndarray:
    rows, columns = found_bad(recording, raw).T
    mean_adu = mean_frame(picked(raw.adu, recording.used))
    background, gain = cleaned.background, recording.acquisition.detector.e_per_adu
    return ((mean_adu - background.adu) / background.flat * gain)[rows, columns]


def _acquisition(product: Product, prefix: str) -> Acquisition:
    content = json.loads(str(product.arrays[f"{prefix}/acquisition"].value))
    content.pop("subaperture", None)  # of earlier versions
    return Acquisition(
        **content
        | {
            "detector": Detector(**content["detector"]),
            "spectrum": tuple((wavelength, weight) for wavelength, weight in content["spectrum"]),
            "diversity": {int(noll): nm for noll, nm in content["diversity"].items()},
        }
    )
