"""Recordings as ingest makes them: clean frames in electrons, and how they were taken."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from irlos_pipe.frames.recording import Recording
from irlos_pipe.instrument.instrument import Instrument, load_instrument
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.ingest.sources import read_sources, with_darks
from irlos_pipe.stages.ingest.stage import Config
from irlos_pipe.stages.ingest.work import ingest


def read_recordings(
    path: Path | str, instrument: Instrument | str = "irlos", acquisition: Mapping[str, Any] | None = None
) -> list[Recording]:
    """Read and clean the recordings at `path`.

    Parameters
    ----------
    path : Path or str
        A SPARTA recorder folder, MUSE raw file, FITS cube or AOT file, or a folder that contains them.
    instrument : Instrument or str
        The profile, its name, or the path of its file.
    acquisition : mapping, optional
        Keys that win over those of side-cars, for example ``{"role": "psf"}``.

    Returns
    -------
    list of Recording
        ``images_e`` [e-] are (frames, rows, columns); ``used`` says which frames are good.

    Raises
    ------
    NothingToDo
        When there is no recording.
    InputDataError
        When one cannot be used.
    """
    profile = load_instrument(str(instrument)) if isinstance(instrument, (str, Path)) else instrument
    config = Config(acquisition=AcquisitionKeys.model_validate(acquisition or {}))
    log = logging.getLogger("irlos_pipe")
    sources, _ = read_sources({"recordings": (Path(path),)}, config.keys_for, profile, log)
    return [ingest(source, config, profile)[0] for source in with_darks(sources)[0]]
