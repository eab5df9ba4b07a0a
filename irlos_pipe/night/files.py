"""What can be done with some files: the one reduction that they make, sorted as those of a night are."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, NothingToDo
from irlos_pipe.conventions.text import and_more
from irlos_pipe.files.shipped import RECIPES, named_file
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.night.database import copied
from irlos_pipe.night.grouping import group_recordings
from irlos_pipe.night.recordings import Description, LeftOut, discover, utc_time
from irlos_pipe.night.reduce import Job, jobs_of
from irlos_pipe.night.settings import NightSettings, load_settings
from irlos_pipe.product.printed import FoundRecording, FoundRecordings
from irlos_pipe.readers.find import read_recordings, recording_files, stated_instruments
from irlos_pipe.readers.sidecar import sidecar_path

NO_RECIPE = (
    "{0}: no recipe is meant for a recording of role {1}; choose one with --recipe NAME (irlos recipes)"
)
NO_CUBE = "a ramp, and no calibration cube of its configuration among the files ({0}); give one as well"
ANY_TIME = {"series_gap_min": 1440.0, "calibration_nights": 400}  # files are given together on purpose


def reduction_of(files: Sequence[Path], output: Path | None = None, recipe: str = "") -> Job:
    """Return the one reduction that `files` make; products go to `output`, or a folder named after it.

    The `recipe`, a name or a path, takes the place of that of ``irlos night``.

    Raises `InputDataError` when a file cannot be read or lacks what it needs, `NothingToDo` without a star,
    and `ConfigurationError` when they make several reductions, or none has a recipe.
    """
    settings = load_settings().model_copy(update=ANY_TIME)
    recordings, left_out = _described(files, settings)
    if left_out:
        first, reason = left_out[0].recording.path, left_out[0].reason
        hint = "" if sidecar_path(first).is_file() else f"; irlos sidecar {first} writes one to fill in"
        raise InputDataError(f"{reason}{hint}{and_more(left_out)}")
    groups, others = group_recordings(recordings, settings)
    if others:
        first = others[0].recording
        why = NO_CUBE.format(first.configuration) if first.role == "defocus_ramp" else others[0].reason
        raise InputDataError(f"{first.path}: {why}")
    serving = {one for group in groups if group.kind == "ramp" for one in group.inputs["calibration"]}
    groups = [one for one in groups if one.kind != "calibration" or one.first not in serving]
    if not groups:
        raise NothingToDo(f"{', '.join(map(str, files))}: no recording of a star, only darks")
    if len(groups) > 1:
        names = ", ".join(f"{one.first.name} ({one.kind})" for one in groups)
        raise ConfigurationError(
            f"{len(groups)} reductions, not one: {names}; give the files of one, or reduce each with irlos "
            "night; irlos run RECIPE --input NAME=PATH --input NAME=PATH fits several recordings together"
        )
    (group,) = groups
    if recipe:
        chosen = str(named_file(recipe, RECIPES))
        settings = settings.model_copy(update={"recipes": {**settings.recipes, group.kind: [chosen]}})
    if not settings.recipes_of(group.kind):
        raise ConfigurationError(NO_RECIPE.format(group.first.path, group.first.role))
    job = jobs_of([group], settings, Path())[0]
    folder = output or Path(f"{group.first.name}-{job.task.recipe.stem}")
    return replace(job, task=replace(job.task, folder=folder))


def _described(files: Sequence[Path], settings: NightSettings) -> tuple[list[Description], list[LeftOut]]:
    with copied(None) as database:
        instrument = load_instrument(settings.instrument)
        recordings, left_out = discover(files, settings.acquisition, instrument, database)
    return recordings, left_out


def job_text(job: Job) -> str:
    """Return what a `job` reduces, and the command that does the same."""
    members = dict.fromkeys(one for some in job.group.inputs.values() for one in some)
    lines = [_recording_text(one) for one in members]
    lines.append(f"instrument: {job.task.load().instrument_text}")
    if job.group.choice:
        lines.append(f"calibration: {job.group.choice}")
    command = ["irlos", "run", job.task.recipe.stem if _is_shipped(job) else str(job.task.recipe)]
    command += [word for one in job.task.inputs for word in ("--input", one)]
    return "\n".join([*lines, shlex.join([*command, "--output", str(job.task.folder)])])


def _is_shipped(job: Job) -> bool:
    return job.task.recipe == named_file(job.task.recipe.stem, RECIPES)


def _recording_text(one: Description) -> str:
    said = (
        one.role, one.target, f"{one.frames} frames of {one.window[0]}x{one.window[1]} px",
        one.start_unix_s and f"{one.night} {utc_time(one.start_unix_s)} UTC", one.configuration,
    )  # fmt: skip
    return f"{one.path}: {', '.join(filter(None, said))}"


def found_recordings(path: Path) -> FoundRecordings:
    """Return what the recordings in a file or folder are, and what can be done with each.

    Raises `InputDataError` when it holds none.
    """
    return FoundRecordings(
        path=str(path), recordings=[row for file in recording_files([path]) for row in _rows(file)]
    )


def _rows(file: Path) -> list[FoundRecording]:
    stated = next(iter(stated_instruments([file])), None)
    instrument = stated.load() if stated else load_instrument("irlos")
    sidecar, command = sidecar_path(file), shlex.quote(str(file))
    recordings, _ = _described([file], load_settings())
    roles = {one.name: {"role": one.role, "target": one.target} for one in recordings}
    told = {
        "sidecar": str(sidecar) if sidecar.is_file() else "",
        "instrument": instrument.name if stated else "",
    }
    try:
        told["recipe"] = reduction_of([file]).task.recipe.stem
        commands = [f"irlos reduce {command}"]
    except (ConfigurationError, InputDataError, NothingToDo) as error:
        told["problem"] = str(error)
        missing = not told["sidecar"]
        commands = [f"irlos sidecar {command} --instrument NAME"] if missing else []
    return [
        FoundRecording(
            file=str(file),
            layout=raw.layout,
            mode=raw.mode,
            frames=raw.frames,
            window=raw.window,
            commands=commands,
            **told,
            **roles.get(raw.name, {}),
        )
        for raw in read_recordings(file, instrument)
    ]
