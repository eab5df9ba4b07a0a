"""Recordings as arrays of the ingest product, and back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.product.product import Product, Quantity

ROOT = "recordings"
# attribute: unit and description; stored as they are
PER_RECORDING = {
    "images_e": ("e-", "signal above background (frame, y, x)"),
    "used": ("", "frame is used"),
    "reason": ("", "why a frame is not used"),
    "pixel_mask": ("", "pixel is good (y, x)"),
    "time_s": ("s", "time since the first frame"),
    "frame_counter": ("", "counter of the recorder"),
    "introduced_defocus_nm": ("nm", "introduced defocus, RMS"),
    "background_variance_e2": ("e-2", "variance per pixel beyond read noise and photons of the star"),
    "dark_variance_e2": ("e-2", "variance per pixel of the dark image, the same in every frame"),
    "frames_missing": ("", "frames the recorder lost"),
    "start_unix_s": ("s", "time of the first frame since 1970"),
}
LATER = ("dark_variance_e2",)  # products of ingest's first version have none
SCALARS = {
    "background_variance_e2": float,
    "dark_variance_e2": float,
    "frames_missing": int,
    "start_unix_s": float,
}


def prefix_of(recording: Recording) -> str:
    """Where a recording lies in the product: ``recordings/<input>/<name>``."""
    return f"{ROOT}/{recording.input}/{recording.name}"


def arrays_from_recording(recording: Recording, prefix: str) -> dict[str, Quantity]:
    """Return everything a recording holds as arrays whose names begin with `prefix`."""
    arrays = {
        f"{prefix}/{name}": Quantity(np.asarray(getattr(recording, name)), unit, description)
        for name, (unit, description) in PER_RECORDING.items()
    }
    text = np.asarray(_acquisition_json(recording.acquisition), dtype=object)
    arrays[f"{prefix}/acquisition"] = Quantity(
        text, "", "how it was taken, and where each key came from (JSON)"
    )
    return arrays


def recordings_from_product(product: Product, input: str | None = None) -> list[Recording]:
    """Return the recordings of an ingest product, in the order in which they were read.

    Parameters
    ----------
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


def _keys(product: Product) -> list[tuple[str, str]]:
    """Input and name of every recording, as listed in the results, others behind."""
    listed = [(row.get("input"), row.get("name")) for row in product.results.get("inputs", [])]
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
    kept = [key for key in PER_RECORDING if key not in LATER or f"{prefix}/{key}" in product.arrays]
    stored = {key: product.arrays[f"{prefix}/{key}"].value for key in kept}
    stored |= {key: kind(stored[key]) for key, kind in SCALARS.items() if key in stored}
    text = str(product.arrays[f"{prefix}/acquisition"].value)
    return Recording(name=name, input=owner, acquisition=_acquisition(json.loads(text)), **stored)


def _acquisition_json(acquisition: Acquisition) -> str:
    return json.dumps(asdict(acquisition), sort_keys=True)


def _acquisition(content: dict[str, Any]) -> Acquisition:
    return Acquisition(
        **content
        | {
            "detector": Detector(**content["detector"]),
            "spectrum": tuple((wavelength, weight) for wavelength, weight in content["spectrum"]),
            "diversity": {int(noll): nm for noll, nm in content["diversity"].items()},
        }
    )
