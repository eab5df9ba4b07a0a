"""Recordings as arrays of the ingest product, and back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import Acquisition, Recording, mean_frame, picked
from irlos_pipe.frames.series import DECLARED, frame_series
from irlos_pipe.product.product import Product, Quantity, declared
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.ingest.stage import RECORDING, ROOT, IngestResults

if TYPE_CHECKING:
    from irlos_pipe.frames.cleaning import Cleaned
    from irlos_pipe.readers.raw_file import RawRecording

# Attributes of a recording that are arrays of the product. Those with a default are single numbers, of which
# a product of an earlier version may lack some.
STORED = [one for one in fields(Recording) if one.name not in ("name", "input", "acquisition")]
ACQUISITION = TypeAdapter(Acquisition)  # as it is stored, JSON
CALLED = {one.name: one.name for one in STORED} | {"good": "pixel_mask"}


@dataclass(frozen=True)
class Overview:
    """What a report shows of a recording: attributes of `Recording`, without the frames."""

    name: str
    input: str
    acquisition: Acquisition
    good: np.ndarray
    start_unix_s: float
    mean_e: np.ndarray  # mean of the used frames [e-], (rows, columns)
    used: np.ndarray  # (frames,); `time_s` as well
    time_s: np.ndarray
    series: dict[str, np.ndarray]  # see `frames.series`, (frames,) each; empty of an earlier version


def prefix_of(recording: Recording) -> str:
    """Return where a recording lies in the product: ``recordings/<input>/<name>``."""
    return f"{ROOT}/{recording.input}/{recording.name}"


def arrays_from_recording(recording: Recording) -> dict[str, Quantity]:
    """Return everything that a recording holds, and the mean of its frames, as arrays of the product."""
    values = {name: getattr(recording, attribute) for attribute, name in CALLED.items()}
    told = json.dumps(asdict(recording.acquisition), sort_keys=True)
    values |= {"acquisition": np.asarray(told, dtype=object), "mean_e": recording.mean_e}
    return declared(RECORDING, values, below=f"{prefix_of(recording)}/")


def arrays_of(recording: Recording, cleaned: Cleaned, raw: RawRecording) -> dict[str, Quantity]:
    """Return all arrays that ingest leaves of a `recording`, made from `raw` and `cleaned`."""
    hits = cleaned.hits
    rows, columns = found_bad(recording, raw).T
    mean_adu = mean_frame(picked(raw.adu, recording.used))
    background, gain = cleaned.background, recording.acquisition.detector.e_per_adu
    own = {
        "raw_adu": raw.adu,
        "background_adu": cleaned.background.adu,
        "flat": cleaned.background.flat,
        "cosmic_hits": np.stack([hits.frame, hits.row, hits.column], axis=1),
        "screened_e": ((mean_adu - background.adu) / background.flat * gain)[rows, columns],
    } | frame_series(recording.images_e, recording.good)
    return arrays_from_recording(recording) | declared(RECORDING, own, below=f"{prefix_of(recording)}/")


def found_bad(recording: Recording, raw: RawRecording) -> np.ndarray:
    """Return the bad pixels of a `recording` that no map of dead pixels of `raw` lists, (pixels, 2)."""
    listed = raw.calibration.bad
    found = ~recording.good if listed is None else ~recording.good & ~np.asarray(listed, bool)
    return np.argwhere(found)


def screened_e(product: Product, recording: Recording) -> dict[tuple[int, int], float]:
    """Return what the bad pixels that ingest found in a `recording` of its `product` had shown.

    That is the mean signal [e-] by (row, column).

    Raises `InputDataError` when the product is of an earlier version, which did not keep them.
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
    """Return the recordings of an ingest `product`, those of one `input` if it is given, as they were read.

    Raises `InputDataError` when there are none.
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
    stored: dict[str, Any] = {}
    for one in STORED:
        array, single = f"{prefix}/{CALLED[one.name]}", one.default is not MISSING
        if array in product.arrays or not single:
            value = product.arrays[array].value
            stored[one.name] = value.item() if single else value
    return Recording(name=name, input=owner, acquisition=_acquisition(product, prefix), **stored)


def _overview(product: Product, owner: str, name: str) -> Overview:
    prefix = f"{ROOT}/{owner}/{name}"
    stored = {key for key in RECORDING if f"{prefix}/{key}" in product.arrays}

    def own(key: str) -> np.ndarray:
        return np.asarray(product.arrays[f"{prefix}/{key}"].value)

    return Overview(
        name,
        owner,
        _acquisition(product, prefix),
        own("pixel_mask"),
        float(own("start_unix_s")),
        own("mean_e")
        if "mean_e" in stored
        else _recording(product, owner, name).mean_e,  # of earlier versions
        own("used"),
        own("time_s"),
        {key: own(key) for key in DECLARED if key in stored},
    )


def _acquisition(product: Product, prefix: str) -> Acquisition:
    stored = str(product.arrays[f"{prefix}/acquisition"].value)
    try:
        return ACQUISITION.validate_json(stored, extra="forbid")
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, problem["loc"]))
        raise InputDataError(
            f"the {product.stage} product was made by another version ({prefix}: {key}: {problem['msg']}); "
            "run ingest again"
        ) from None
