"""What was observed: the facts of a recording that every product of it hands on."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Any

from pydantic import ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.results import DITTO, ByNoll, Number, ResultsPart, item


class Observed(ResultsPart):
    """How and when a recording was taken."""

    file: str = item("", "Name of the data file.")
    start: str = item("", "Time of the first frame, UTC, ISO 8601; empty where it is not known.")
    cards: dict[str, Any] = item({}, "Cards of the file's primary header that products inherit, by keyword.")
    instrument: str = item("", "Name of the instrument profile.")
    target: str = item("", "Name of the star.")
    mode: str = item("", "Read-out mode; empty where the layout has none.")
    exposure_s: Number = item(nan, "Exposure of a frame, and frames per second.")
    frame_rate_hz: Number = item(nan, DITTO)
    mag_j: Number = item(nan, "J magnitude of the star.")
    pixel_scale_mas: Number = item(nan, "Scale of the images, per pixel.")
    wavelength_nm: Number = item(nan, "Mean wavelength of the photons.")
    diversity_source: str = item("", "What introduced the diversity, such as ``lens``.")
    diversity_nm: ByNoll = item({}, "Introduced diversity by Noll index [nm RMS].")
    derotator_angle_deg: Number = item(nan, "Angles; NaN where they are not known.")
    parallactic_angle_deg: Number = item(nan, DITTO)
    altitude_deg: Number = item(nan, DITTO)
    pupil_rotation_deg: Number = item(nan, DITTO)


class Recorded(Observed):
    """The same with the place of the recording in a run."""

    name: str = ""
    input: str = ""
    role: str = ""
    frames: int = 0
    frames_rejected: int = 0
    window: tuple[int, ...] = ()


def recorded(provenance: Mapping[str, Any]) -> list[Recorded]:
    """Return the recordings that a product was made from, as its `provenance` lists them.

    Raises
    ------
    InputDataError
        When the list is damaged.
    """
    try:
        return [Recorded.model_validate(entry) for entry in provenance.get("recordings", ())]
    except (TypeError, ValidationError) as error:
        raise InputDataError("provenance: recordings cannot be read; run the recipe again") from error
