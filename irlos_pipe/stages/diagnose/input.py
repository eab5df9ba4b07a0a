"""Recordings that a diagnosis takes together: those that are alike pooled, by star and night."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnosis.view import Screened
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Product
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product, screened_e
from irlos_pipe.stages.model.recording_settings import differences, in_time_order

COMMON = {"pixel_scale_mas": "pixel scale", "derotator_angle_deg": "derotator angle"}
NIGHT_S = 12 * 3600.0  # between recordings, from which they are of different nights


@dataclass(frozen=True)
class Alike:
    """Recordings of one moment with equal settings.

    Attributes
    ----------
    recordings : sequence of Recording
        In order of time.
    moment : int
        Number of the star and night.
    """

    recordings: Sequence[Recording]
    moment: int = 0

    @property
    def first(self) -> Recording:
        """The first recording."""
        return self.recordings[0]

    @property
    def star(self) -> str:
        """What the side-car or header calls it."""
        return self.first.acquisition.target

    @property
    def diversity_nm(self) -> float:
        """Size of the diversity [nm RMS]."""
        return float(np.linalg.norm(list(self.first.acquisition.diversity.values())))


def by_setting(ingest: Product, input_name: str, *, apart: bool | None = None) -> list[Alike]:
    """Return the used frames of the input `input_name` of `ingest`, one group per setting and moment.

    The setting with the largest diversity comes first: errors of the diversity are stated for it.

    Parameters
    ----------
    ingest : Product
    input_name : str
    apart : bool, optional
        Whether every recording is of its own star or night, or all are of one; by default targets and times
        tell.

    Raises
    ------
    InputDataError
        If recordings of one moment differ in more than focus, diversity and band.
    """
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    _require_common(recordings)
    groups: dict[tuple, list[Recording]] = {}
    for recording, moment in zip(recordings, moments_of(recordings, apart), strict=True):
        groups.setdefault((moment, *_setting(recording)), []).append(recording)
    found = [Alike(alike, key[0]) for key, alike in groups.items()]
    return sorted(found, key=lambda alike: -alike.diversity_nm)


def moments_of(recordings: Sequence[Recording], apart: bool | None = None) -> list[int]:
    """Return the number of the star and night of every recording, from 0 in the order given.

    `recordings` in order of time; `apart`: see `by_setting`.
    """
    if apart is not None:
        return [number if apart else 0 for number in range(len(recordings))]
    night, last_s = 0, float("nan")
    known: dict[tuple[str, int], int] = {}
    found = []
    for recording in recordings:
        night += bool(recording.start_unix_s - last_s > NIGHT_S)
        last_s = recording.start_unix_s
        found.append(known.setdefault((recording.acquisition.target, night), len(known)))
    return found


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
    return acquisition.spectrum, diversity, introduced_nm(recording), acquisition.pupil_rotation_deg


def _require_common(recordings: list[Recording]) -> None:
    """Raise InputDataError unless window, pixel scale and derotator angle are the same."""
    for other in recordings[1:]:
        differing = differences(recordings[0], other, COMMON)
        if differing:
            raise InputDataError(
                f"{other.name}: {' and '.join(differing)} of {recordings[0].name} are others; cubes "
                "diagnosed together may differ in star, night, focus, diversity and band only"
            )
