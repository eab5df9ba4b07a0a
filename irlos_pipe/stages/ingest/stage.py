"""Stage `ingest`: from the files of the recorder to clean frames in electrons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from irlos_pipe.conventions.errors import NothingToDo
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.ingest.config import Config
from irlos_pipe.stages.ingest.results import ARRAYS, CHECKS
from irlos_pipe.stages.ingest.results import IngestResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "files_of", "problems", "run"]

NAME = "ingest"
VERSION = 12
READS = ()
DEPENDS_ON = frozenset({"instrument", "inputs"})


def files_of(root: Path) -> list[Path]:
    """Return every file that ingest reads of an input, given as a file or folder `root`."""
    from irlos_pipe.readers.find import files_of as recording_parts
    from irlos_pipe.readers.find import recording_files

    with suppress(NothingToDo):
        return [path for recording in recording_files([root]) for path in recording_parts(recording)]
    return []


def problems(inputs: Mapping[str, Sequence[Path]], config: Config, instrument: Instrument) -> list[str]:
    """Return a line for everything that is wrong with the recordings of `inputs` and their side-cars."""
    from irlos_pipe.stages.ingest.sources import source_problems

    return source_problems(inputs, config.keys_for, instrument)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Read, calibrate and screen every recording of every input."""
    from irlos_pipe.stages.ingest.work import run as work

    return work(ctx)
