"""Recorded frames once more, as the stage `lift` gets them: the same electrons in the same order."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.recipe.load import load_recipe
from irlos_pipe.stages.model.recording_settings import used_in_time_order


class Replay:
    """Used frames of one input of a run, in order of time, see `Source`; counted from 0.

    Parameters
    ----------
    run : Path
        Folder of the run.
    input_name : str
    speed : float
        Times the rate at which the frames were taken; 0 is as fast as they can be measured.

    Raises
    ------
    InputDataError
        If the run has no such input.
    """

    def __init__(self, run: Path, input_name: str, speed: float = 0.0):
        run_folder = existing_run(run)
        path = run_folder.products().get("ingest")
        if path is None:
            raise InputDataError(f"{run}: holds no ingested frames; run its recipe again")
        try:
            recordings = used_in_time_order(open_product(path), input_name)
        except (KeyError, IndexError):
            recordings = []
        if not recordings:
            raise InputDataError(f"{run}: has no input '{input_name}' with frames")
        self.window, self.acquisition = recordings[0].window, recordings[0].acquisition
        self.instrument_name = load_recipe(run_folder.recipe, complete=False).instrument_name
        self._reads = self._in_order(recordings)
        self._speed, self._started = speed, time.monotonic()
        self._first_s = math.nan

    def poll(self, timeout_s: float) -> Sequence[Read] | None:
        """See `Source.poll`."""
        read = next(self._reads, None)
        if read is None:
            return None
        self._wait(read.unix_s)
        return [read]

    def close(self) -> None:
        """See `Source.close`."""

    def _in_order(self, recordings) -> Iterator[Read]:
        number = 0
        for recording in recordings:
            for time_s, image_e in zip(recording.time_s, recording.images_e, strict=True):
                yield Read(number, recording.start_unix_s + float(time_s), image_e)
                number += 1

    def _wait(self, unix_s: float) -> None:
        if self._speed <= 0 or math.isnan(unix_s):
            return
        self._first_s = unix_s if math.isnan(self._first_s) else self._first_s
        due = self._started + (unix_s - self._first_s) / self._speed
        time.sleep(min(max(0.0, due - time.monotonic()), 3600.0))
