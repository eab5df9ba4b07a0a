"""Recordings of one wavefront that a diagnosis takes together: those that are alike pooled."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnose.view import Screened
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Product
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product, screened_e
from irlos_pipe.stages.model.recording_settings import differences, in_time_order

COMMON = {"pixel_scale_mas": "pixel scale", "derotator_angle_deg": "derotator angle"}


def by_setting(ingest: Product, input_name: str) -> list[list[Recording]]:
    """Return the used frames of the input `input_name` of `ingest` in order of time, one list per setting.

    The setting with the largest diversity comes first: errors of the diversity are stated for it.

    Raises
    ------
    InputDataError
        If recordings differ in more than focus, diversity and band.
    """
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    _require_common(recordings)
    settings: dict[tuple, list[Recording]] = {}
    for recording in recordings:
        settings.setdefault(_setting(recording), []).append(recording)
    return sorted(settings.values(), key=lambda alike: -_size(alike[0].acquisition.diversity))


def introduced_nm(recording: Recording) -> float:
    """Introduced defocus of all its used frames.

    Raises
    ------
    InputDataError
        If it changes during the recording.
    """
    values = np.unique(recording.introduced_defocus_nm)
    if len(values) > 1:
        raise InputDataError(
            f"{recording.name}: the introduced defocus changes from frame to frame; a diagnosis takes "
            "recordings of one defocus each, or the recipe diagnose_ramp"
        )
    return float(values[0]) if len(values) else 0.0


def screened_pixels(ingest: Product, recording: Recording) -> list[Screened]:
    """Return the pixels of a `recording` that `ingest` found bad, with the mean of what they showed."""
    shown_e = screened_e(ingest, recording)
    return [Screened(*pixel, value_e) for pixel, value_e in shown_e.items() if np.isfinite(value_e)]


def _setting(recording: Recording) -> tuple:
    acquisition = recording.acquisition
    diversity = tuple(sorted((noll, nm) for noll, nm in acquisition.diversity.items() if nm))
    return acquisition.spectrum, diversity, introduced_nm(recording)


def _size(diversity: dict[int, float]) -> float:
    return float(np.linalg.norm(list(diversity.values())))


def _require_common(recordings: list[Recording]) -> None:
    """Raise InputDataError unless window, pixel scale and derotator angle are the same."""
    for other in recordings[1:]:
        differing = differences(recordings[0], other, COMMON)
        if differing:
            raise InputDataError(
                f"{other.name}: {' and '.join(differing)} of {recordings[0].name} are others; cubes "
                "diagnosed together may differ in focus, diversity and band only"
            )
