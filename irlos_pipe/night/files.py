"""What can be done with some files: the one reduction that they make, sorted as those of a night are."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError, NothingToDo
from irlos_pipe.conventions.text import aligned, and_more, printable
from irlos_pipe.files.shipped import RECIPES, named_file
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.night.database import copied
from irlos_pipe.night.grouping import group_recordings
from irlos_pipe.night.recordings import Description, LeftOut, discover, utc_time
from irlos_pipe.night.reduce import Job, jobs_of
from irlos_pipe.night.settings import load_settings
from irlos_pipe.product.printed import ShownRecordings
from irlos_pipe.readers.find import read_recordings, recording_files
from irlos_pipe.readers.sidecar import sidecar_path, stated_instrument, stated_instruments

NO_CUBE = "a ramp, and no calibration cube of its configuration among the files ({0}); give one as well"
NO_RECIPE = "no recipe is meant for a recording of role {0}; choose one with --recipe NAME (irlos recipes)"
SEVERAL = (
    "{0} reductions, not one: {1}; give the files of one, or reduce each with irlos night; "
    "irlos run RECIPE --input NAME=PATH --input NAME=PATH fits several recordings together"
)
ANY_TIME = {"series_gap_min": 1440.0, "calibration_nights": 400}  # files are given together on purpose


def reduction_of(files: Sequence[Path], output: Path | None = None, recipe: str | None = None) -> Job:
    """Return the one reduction that `files` make; products go to `output`, or a folder named after it.

    The `recipe`, a name or a path, takes the place of that of ``irlos night``.

    Raises `InputDataError` when a file cannot be read or lacks what it needs, `NothingToDo` without a star,
    and `ConfigurationError` when they make several reductions, or none has a recipe.
    """
    settings = load_settings().model_copy(update=ANY_TIME)
    recordings, unusable = _described(files)
    for one in unusable:
        path = one.recording.path
        hint = "" if sidecar_path(path).is_file() else f"; irlos sidecar {path} writes one to fill in"
        raise InputDataError(f"{one.reason}{hint}{and_more(unusable)}")
    groups, left_out = group_recordings(recordings, settings)
    for one in left_out:
        cube = one.recording.role == "defocus_ramp"
        why = NO_CUBE.format(one.recording.configuration) if cube else one.reason
        raise InputDataError(f"{one.recording.path}: {why}")
    serving = {one for group in groups if group.kind == "ramp" for one in group.inputs["calibration"]}
    groups = [one for one in groups if one.kind != "calibration" or one.first not in serving]
    if not groups:
        raise NothingToDo(f"{', '.join(map(str, files))}: no recording of a star, only darks")
    if len(groups) > 1:
        names = ", ".join(f"{one.first.name} ({one.kind})" for one in groups)
        raise ConfigurationError(SEVERAL.format(len(groups), names))
    (group,) = groups
    if recipe:
        chosen = {**settings.recipes, group.kind: [str(named_file(recipe, RECIPES))]}
        settings = settings.model_copy(update={"recipes": chosen})
    for job in jobs_of([group], settings, Path()):
        folder = output or Path(f"{group.first.name}-{job.task.recipe.stem}")
        return replace(job, task=replace(job.task, folder=folder))
    raise ConfigurationError(f"{group.first.path}: {NO_RECIPE.format(group.first.role)}")


def _described(files: Sequence[Path]) -> tuple[list[Description], list[LeftOut]]:
    settings = load_settings()
    with copied(None) as database:
        return discover(files, settings.acquisition, load_instrument(settings.instrument), database)


def job_text(job: Job) -> str:
    """Return what a `job` reduces, and the command that does the same."""
    lines = [_said(one) for one in dict.fromkeys(one for some in job.group.inputs.values() for one in some)]
    lines.append(f"instrument: {job.task.load().instrument_text}")
    lines += [f"calibration: {job.group.choice}"] if job.group.choice else []
    recipe = job.task.recipe
    command = ["irlos", "run", recipe.stem if recipe == named_file(recipe.stem, RECIPES) else str(recipe)]
    command += [word for one in job.task.inputs for word in ("--input", one)]
    return "\n".join([*lines, shlex.join([*command, "--output", str(job.task.folder)])])


def _said(one: Description) -> str:
    when = f"{one.night} {utc_time(one.start_unix_s)} UTC" if one.start_unix_s else ""
    frames = f"{one.frames} frames of {one.window[0]}x{one.window[1]} px"
    return f"{one.path}: {', '.join(filter(None, (one.role, one.target, frames, when, one.configuration)))}"


def found_recordings(path: Path, as_json: bool) -> str:
    """Return what the recordings in a file or folder are and what to do with each: a text, or JSON.

    Raises `InputDataError` when a file holds none.
    """
    rows = [row for file in recording_files([path]) for row in _rows(file)]
    if as_json:
        return ShownRecordings(recordings=rows).text()
    return "\n\n".join(aligned([(key, printable(value)) for key, value in row.items()]) for row in rows)


def _rows(file: Path) -> Iterator[dict[str, str]]:
    stated, command = stated_instruments([file]), f"irlos reduce {shlex.quote(str(file))}"
    instrument = stated_instrument(stated)[1] if stated else load_instrument("irlos")
    described = {one.name: one for one in _described([file])[0]}
    for raw in read_recordings(file, instrument):
        size = f"{raw.frames} of {raw.window[0]}x{raw.window[1]} px"
        row = {"recording": str(file), "frames": ", ".join(filter(None, (size, raw.layout, raw.mode)))}
        row["side-car"] = str(sidecar_path(file)) if sidecar_path(file).is_file() else "none"
        row["instrument"] = instrument.name if stated else "irlos, as no side-car states another"
        if one := described.get(raw.name):
            row["role"] = ", ".join(filter(None, (one.role, one.target)))
        try:
            row["next"] = f"{command}, by recipe {reduction_of([file]).task.recipe.stem}"
        except IrlosError as error:
            row["problem"] = str(error)
        yield row
