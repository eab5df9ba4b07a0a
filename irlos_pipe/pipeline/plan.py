"""What a run will do, stage by stage, and why: by its settings, and the files behind its inputs."""

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, NothingToDo
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import canonical_json, changed_values, json_text, jsonable
from irlos_pipe.files.regular import open_regular, read_regular
from irlos_pipe.product.results import results_of
from irlos_pipe.product.runfolder import RunFolder, listing_stamp, require_free, require_outside_inputs
from irlos_pipe.product.storage import is_intact, read_product
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import Declared, declared_by, reads

CACHE_NAME = ".input_checksums.json"
LISTS = "lists"  # key of the lists of files among the absolute paths of the cache


@dataclass(frozen=True)
class InputFile:
    # ``<input>/<folder or file given>/<path below it>``: the same wherever the data lie. Files next to what
    # was given, such as a side-car, count from its parent folder.
    label: str
    path: Path
    sha256: str
    # Size, times and place on the disk when the checksum was taken.
    stamp: tuple[int, ...] = field(default=(), compare=False)
    # What was given as input, and the stamp of all that decided which of its files are read.
    root: Path = field(default=Path(), compare=False)
    listed: str = field(default="", compare=False)


def input_files(
    inputs: Mapping[str, tuple[Path, ...]],
    cache_folder: Path,
    files_of: Callable[[Path], list[Path]] | None = None,
) -> list[InputFile]:
    """List the files of all inputs with their checksums, ordered by label.

    Checksums of files whose size, times and place did not change come from the cache
    in `cache_folder`, which is not written here (see `remember`), and so does the list of the files that
    are read of an input while nothing in it or next to it was touched: to tell, every file has to be opened.

    ``files_of(root)`` gives the files that are read of a file or folder given as input; all by default.

    Raises `NothingToDo` when there is nothing to read of an input, and `InputDataError` when a folder cannot
    be read, or a name cannot be shown.
    """
    cache = _read_cache(cache_folder)
    found: dict[str, tuple[Path, Path, str]] = {}
    for name, roots in inputs.items():
        own: dict[str, tuple[Path, Path, str]] = {}
        for index, root in enumerate(roots):
            prefix = name if len(roots) == 1 else f"{name}[{index}]"
            listed, paths = _listed(root, cache, files_of or _all_files)
            own |= {f"{prefix}/{_label(path, root)}": (path, root, listed) for path in paths}
        if not own:
            raise NothingToDo(
                f"input '{name}': no recordings under {', '.join(map(str, roots))}; nothing to process"
            )
        found |= own
    return [_input_file(label, *one, cache) for label, one in sorted(found.items())]


def remember(files: list[InputFile], cache_folder: Path) -> None:
    """Write the checksums of `files`, and which of an input they are, to the cache in `cache_folder`."""
    entries: dict[str, Any] = {str(file.path): [*file.stamp, file.sha256] for file in files}
    lists: dict[str, list[str]] = {}
    for file in files:
        lists.setdefault(str(file.root), [file.listed]).append(str(file.path))
    entries[LISTS] = {root: entry for root, entry in lists.items() if entry[0]}
    write_if_changed(cache_folder / CACHE_NAME, json_text(entries).encode())


def require_unchanged(files: Iterable[InputFile]) -> None:
    """Raise InputDataError if one of the `files` is no longer the one whose checksum was taken."""
    for file in files:
        if _stamp(file.path) != file.stamp:
            raise InputDataError(f"{file.path}: changed during the run; run again when it is complete")


def _label(path: Path, root: Path) -> str:
    label = Path(os.path.relpath(path, root.parent)).as_posix()
    if not label.isprintable():  # control characters, and bytes that are no UTF-8
        raise InputDataError(f"{str(path)!r}: the name holds characters that cannot be shown; rename it")
    return label


def _all_files(root: Path) -> list[Path]:
    def unreadable(error: OSError) -> None:
        raise InputDataError(f"{error.filename}: cannot be read: {error.strerror}") from error

    found = [] if root.is_dir() else [root]
    for where, subfolders, names in os.walk(root, onerror=unreadable) if root.is_dir() else ():
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        paths = (Path(where, name) for name in names if not name.startswith("."))
        found += filter(Path.is_file, paths)  # neither pipes nor devices
    return found


def _read_cache(folder: Path) -> dict[str, Any]:
    try:
        entries = json.loads(read_regular(folder / CACHE_NAME))
    except (OSError, ValueError, RecursionError):
        return {}
    return entries if isinstance(entries, dict) else {}


def _listed(
    root: Path, cache: Mapping[str, Any], files_of: Callable[[Path], list[Path]]
) -> tuple[str, list[Path]]:
    """The files that are read of an input, and the stamp under which they may be remembered."""
    stamp = listing_stamp(root)
    entry = cache.get(LISTS, {}).get(str(root)) if isinstance(cache.get(LISTS), dict) else None
    match entry:
        case [str(earlier), *names] if (
            stamp and earlier == stamp and all(isinstance(one, str) for one in names)
        ):
            return stamp, [Path(one) for one in names]
    return stamp, files_of(root)


def _input_file(label: str, path: Path, root: Path, listed: str, cache: Mapping[str, Any]) -> InputFile:
    """A file with its checksum; one that cannot be read fails when it is, and does not stop the others."""
    stamp = _stamp(path)
    match cache.get(str(path)):
        case [*numbers, str(checksum)] if checksum and tuple(numbers) == stamp:
            pass
        case _:
            try:
                with open_regular(path) as stream:
                    checksum = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                checksum = f"cannot be read: {error.strerror}"
    return InputFile(label, path, checksum, stamp, root, listed)


def _stamp(path: Path) -> tuple[int, ...]:
    """Change of the content shows in one of these, also where size and time of modification are kept."""
    if not path.is_file():
        return ()
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


UP_TO_DATE = "up to date"
NO_PRODUCT = "no product yet"
DAMAGED = "product unreadable"
MAX_REASONS = 3  # shown for one stage


class Action(Enum):
    RUN = "run"
    SKIP = "skip"
    USE = "use as it is"
    LEAVE = "not selected"


@dataclass(frozen=True)
class Selection:
    """Which stages a run may touch."""

    first: str | None = None  # name of the first stage (``--from``)
    last: str | None = None  # name of the last stage (``--to``)
    force: bool = False  # run the selected stages even if they are up to date


@dataclass(frozen=True)
class Step:
    name: str
    path: Path  # the stage's product
    key: str  # of the product as it is to be
    parts: dict[str, Any]  # what the key is made of
    action: Action
    reason: str  # why the stage is run, or why not
    current: bool  # whether the product on disk has this key

    def describe(self) -> str:
        redone = self.action is Action.RUN and self.reason != NO_PRODUCT
        return f"{self.name}: {'redone because ' if redone else ''}{self.reason}"


def plan_run(recipe: Recipe, folder: Path, selection: Selection) -> tuple[list[InputFile], list[Step]]:
    """Return the input files and the plan of a run into `folder`, which need not exist; nothing is written.

    Raises `ConfigurationError` when the selection or the output folder cannot be used, and `InputDataError`
    or `NothingToDo` when input files cannot be read, or there are none.
    """
    require_free(folder)
    require_outside_inputs(folder, recipe.inputs)
    readers = filter(None, (declared_by(STAGES[name], "files_of") for name in recipe.stages))
    files = input_files(recipe.inputs, folder, next(readers, None))
    return files, make_plan(recipe, folder, files, selection)


def make_plan(recipe: Recipe, folder: Path, files: Iterable[InputFile], selection: Selection) -> list[Step]:
    """Decide for every stage of the recipe whether it runs.

    Raises `ConfigurationError` when ``--from`` or ``--to`` name no stage of the recipe, or a product that
    ``--from`` builds on is missing.
    """
    first, last = _range(recipe, selection)
    files = list(files)
    steps: list[Step] = []
    for index, name in enumerate(recipe.stages):
        known = {step.name: step.key for step in steps}
        upstream = {other: known[other] for other in reads(STAGES[name], recipe.stages[:index])}
        parts = key_parts(name, recipe, files, upstream)
        path = RunFolder(folder).product(index + 1, name)
        if index < first:
            try:  # its product is used whether or not it is up to date
                stored = _stored(name, path)
            except InputDataError as error:
                raise _unusable(name, recipe.stages[first], str(error)) from error
            outdated = changes(stored["parts"], parts)
            reason = f"used as it is, though {outdated}" if outdated else UP_TO_DATE
            steps.append(Step(name, path, stored["key"], stored["parts"], Action.USE, reason, True))
        else:
            steps.append(_step(name, path, parts, selected=index <= last, force=selection.force))
    return steps


def repaired(step: Step, steps: Sequence[Step]) -> Step:
    """Return a step of the plan `steps`; a damaged product is made again.

    `make_plan` looks at the metadata of products only, so that planning is quick.

    Raises `ConfigurationError` when a product that ``--from`` builds on is damaged.
    """
    if step.action not in (Action.SKIP, Action.USE) or (is_intact(step.path) and _has_results(step)):
        return step
    if step.action is Action.USE:
        first = next(other.name for other in steps if other.action is not Action.USE)
        raise _unusable(step.name, first, f"{step.path}: {DAMAGED}")
    return replace(step, action=Action.RUN, reason=DAMAGED, current=False)


def _has_results(step: Step) -> bool:
    """Whether the results in a product are those of its stage, which no checksum shows."""
    try:
        results_of(STAGES[step.name].Results, read_product(step.path, arrays=False))
    except InputDataError:
        return False
    return True


def _range(recipe: Recipe, selection: Selection) -> tuple[int, int]:
    stages = recipe.stages
    for option, name in (("--from", selection.first), ("--to", selection.last)):
        if name is not None and name not in stages:
            raise ConfigurationError(
                f"{option} {name}: no stage of recipe '{recipe.name}'{suggestion(name, stages)}"
            )
    first, last = (
        stages.index(name or end)
        for name, end in ((selection.first, stages[0]), (selection.last, stages[-1]))
    )
    if first > last:
        raise ConfigurationError(f"--from {selection.first} comes after --to {selection.last}")
    return first, last


def _unusable(name: str, first: str, why: str) -> ConfigurationError:
    return ConfigurationError(
        f"--from {first}: the product of '{name}' cannot be used ({why}); "
        f"run with --from {name}, or without --from"
    )


def _step(name: str, path: Path, parts: dict[str, Any], *, selected: bool, force: bool) -> Step:
    key = checksum(canonical_json(parts).encode())
    outdated = _why_outdated(name, path, parts, key)
    reason = outdated or ("--force was given" if force else UP_TO_DATE)
    action = Action.RUN if outdated or force else Action.SKIP
    if not selected:
        action, reason = Action.LEAVE, f"not selected ({outdated or UP_TO_DATE})"
    return Step(name, path, key, parts, action, reason, not outdated)


def _why_outdated(name: str, path: Path, parts: Mapping[str, Any], key: str) -> str:
    """Return why the product on disk cannot stay, or nothing when it can."""
    if not path.is_file():
        return NO_PRODUCT
    try:
        stored = _stored(name, path)
    except InputDataError:
        return DAMAGED
    if stored["key"] != key:
        return changes(stored["parts"], parts) or "what it was made from changed"
    return next(filter(None, (_amiss(path.parent / name, stored) for name in stored["files"])), "")


def _amiss(file: Path, stored: Mapping[str, Any]) -> str:
    """Return what is wrong with a further file of a product, if anything; earlier ones have no checksum."""
    if not file.is_file():
        return f"{file.name} is missing"
    written = stored.get("file_sha256", {}).get(file.name)
    return f"{file.name} was changed" if written not in (None, checksum(file.read_bytes())) else ""


def _stored(name: str, path: Path) -> dict[str, Any]:
    product = read_product(path, arrays=False)
    needed = {"key", "parts", "files", "summary", "failures"}
    if product.stage != name or not needed <= product.provenance.keys():
        raise InputDataError(f"{path}: not a product of stage '{name}' made by a run")
    return product.provenance


# -- the key of a product: a checksum of everything it depends on, and what of it changed --------


def checksum(content: bytes) -> str:
    """Return the SHA-256 of some `content`."""
    return hashlib.sha256(content).hexdigest()


def key_parts(
    stage: str, recipe: Recipe, files: Iterable[InputFile], upstream: Mapping[str, str]
) -> dict[str, Any]:
    """Return all that the product of `stage` depends on, in JSON types."""
    parts = {
        "model": recipe.model,
        "instrument": recipe.instrument,
        "seed": recipe.seed,
        "inputs": {file.label: file.sha256 for file in files},
    }
    own = {
        "stage": stage,
        "version": STAGES[stage].VERSION,
        "config": recipe.configs[stage],
        "upstream": dict(upstream),
    }
    return jsonable(own | {name: parts[name] for name in sorted(declared_by(STAGES[stage], "DEPENDS_ON"))})


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Describe how the parts of two keys, `old` and `new`, differ; the first few differences in full."""
    stage = str(new["stage"])
    reasons = [_difference(name, stage, *values) for name, values in changed_values(old, new).items()]
    more = len(reasons) - MAX_REASONS
    return "; ".join(reasons[:MAX_REASONS]) + (f"; and {more} more" if more > 0 else "")


def _difference(name: tuple[str, ...], stage: str, before: Any, after: Any) -> str:
    part, rest = name[0], ".".join(name[1:])
    if part in ("inputs", "upstream"):
        verb = "is new" if before is None else "is gone" if after is None else "changed"
        return f"{'input file' if part == 'inputs' else part} {rest} {verb}"
    label = {"config": f"{stage}.{rest}", "version": "stage version"}.get(part, ".".join(name))
    verb = "" if part == "version" else " changed"
    return f"{label}{verb} {_shown(before)} -> {_shown(after)}"


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def input_problems(recipe: Recipe, stages: Collection[str] | None = None) -> list[str]:
    """Return a line for everything that is wrong with the recordings of a recipe and their side-cars.

    Of `stages` alone, if they are given.

    Raises `NothingToDo` when there are no recordings under an input, and `ConfigurationError` where the
    recipe's model means nothing for one.
    """
    wanted = recipe.stages if stages is None else stages
    given = {key: paths for key, paths in recipe.inputs.items() if paths}
    lines, recordings = list[str](), list[Any]()
    for name in wanted and recipe.stages:
        if examine := getattr(STAGES[name], "examined", None):
            wrong, declared = examine(given, recipe.configs[name], recipe.instrument)
            lines, recordings = [*lines, *wrong], [*recordings, *declared]
    for name in () if lines else wanted:
        config = recipe.configs[name]
        own = [one for one in recordings if one.input == getattr(config, "input", None)]
        if own and (require := getattr(STAGES[name], "require", None)):
            try:
                require(Declared(config, recipe.model, recipe.instrument, own))
            except InputDataError as error:
                lines.append(str(error))
    return list(dict.fromkeys(lines))
