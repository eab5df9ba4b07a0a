"""What was observed: the facts of a recording that every product of it hands on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.results import ByNoll, Number, ResultsPart


class Observed(ResultsPart):
    """How and when a recording was taken.

    Attributes
    ----------
    file : str
        Name of the data file.
    start : str
        Time of the first frame, UTC, ISO 8601; empty where it is not known.
    cards : dict
        Cards of the file's primary header that products inherit, by keyword.
    instrument : str
        Name of the instrument profile.
    target : str
        Name of the star.
    mode : str
        Read-out mode; empty where the layout has none.
    exposure_s, frame_rate_hz : float
        Exposure of a frame, and frames per second.
    mag_j : float
        J magnitude of the star.
    pixel_scale_mas : float
        Scale of the images, per pixel.
    wavelength_nm : float
        Mean wavelength of the photons.
    diversity_source : str
        What introduced the diversity, such as ``lens``.
    diversity_nm : dict of int to float
        Introduced diversity by Noll index [nm RMS].
    derotator_angle_deg, parallactic_angle_deg, altitude_deg, pupil_rotation_deg : float
        Angles; NaN where they are not known.
    """

    file: str = ""
    start: str = ""
    cards: dict[str, Any] = {}
    instrument: str = ""
    target: str = ""
    mode: str = ""
    exposure_s: Number = math.nan
    frame_rate_hz: Number = math.nan
    mag_j: Number = math.nan
    pixel_scale_mas: Number = math.nan
    wavelength_nm: Number = math.nan
    diversity_source: str = ""
    diversity_nm: ByNoll = {}
    derotator_angle_deg: Number = math.nan
    parallactic_angle_deg: Number = math.nan
    altitude_deg: Number = math.nan
    pupil_rotation_deg: Number = math.nan


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
