"""Many samples of one function, in worker processes; finished ones outlive an interruption."""

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.files.atomic import atomic_file
from irlos_pipe.files.json import canonical_json
from irlos_pipe.files.processes import in_processes
from irlos_pipe.stages.base import StageContext

Rows = list[dict[str, Any]]
Function = Callable[[Any], Iterable[Mapping[str, Any]]]
SCALARS = "rows"  # entry of a sample's file; the others are arrays, each by its row and its name


def run_samples(function: Function, samples: Sequence[Any], ctx: StageContext[Any], desc: str) -> list[Rows]:
    """Return the rows `function(sample)` of every sample, computed by `ctx.jobs` processes of one thread.

    Every result is a file in `ctx.scratch` as soon as it is there, and is read from it when the
    same stage runs again after an interruption. Results are the same to the bit for any
    `ctx.jobs`, as long as `function` depends on nothing but the sample, its seed included.

    The `function` is defined at the top level of a module and returns or yields rows: numbers, arrays or
    texts by name. The `samples`, of which equal ones are computed once, are frozen dataclasses of what JSON
    can hold, arrays included, with a ``name`` for messages; `desc` says what they are there and on the
    progress bar.

    Raises `IrlosError` as `function` does, with the sample's name put before it, or when a process died; the
    samples finished by then stay.
    """
    ctx.scratch.mkdir(parents=True, exist_ok=True)
    files = [ctx.scratch / f"{sample_key(function, one)}.npz" for one in samples]
    missing = {file: one for file, one in zip(files, samples, strict=True) if not zipfile.is_zipfile(file)}
    total = len(set(files))
    finished = total - len(missing)
    if finished:
        ctx.log.info("%s: %d of %d samples were finished before", desc, finished, total)
    with ctx.progress(total=total, desc=desc) as bar:
        bar.update(finished)
        if missing:
            calls = [(function, one, file) for file, one in missing.items()]
            with in_processes(min(ctx.jobs, len(calls)), _work, calls) as futures:
                names = {future: one.name for future, one in zip(futures, missing.values(), strict=True)}
                for done in as_completed(futures):
                    try:
                        done.result()
                    except BrokenProcessPool as error:
                        raise IrlosError(
                            f"{desc}: a worker process was killed, perhaps because memory ran out; finished "
                            "samples stay: run the same command to go on, with fewer --jobs"
                        ) from error
                    except IrlosError as error:
                        raise type(error)(f"{desc}: sample {names[done]}: {error}") from error
                    except Exception as error:
                        error.add_note(f"{desc}: sample {names[done]}")
                        raise
                    bar.update(1)
    return [_read(file) for file in files]


def sample_key(function: Callable, sample: Any) -> str:
    """Return a checksum of the name of `function` and of `sample`, the same in every process."""
    identity = [function.__module__, function.__qualname__, type(sample).__qualname__, sample]
    return hashlib.sha256(canonical_json(identity).encode()).hexdigest()[:32]


def _work(function: Function, sample: Any, file: Path) -> None:
    scalars: Rows = []
    arrays: dict[str, Any] = {}
    for index, row in enumerate(function(sample)):
        values = {name: np.asarray(value) for name, value in row.items()}
        for name, value in values.items():
            if value.dtype.hasobject:
                raise TypeError(f"{function.__qualname__}: '{name}' is neither numbers nor text")
        scalars.append({name: value.item() for name, value in values.items() if not value.ndim})
        arrays |= {f"{index}/{name}": value for name, value in values.items() if value.ndim}
    arrays[SCALARS] = np.array(json.dumps(scalars))
    with atomic_file(file) as stream:
        np.savez(stream, **arrays)


def _read(file: Path) -> Rows:
    with np.load(file, allow_pickle=False) as found:
        rows: Rows = json.loads(str(found[SCALARS]))
        for key in found.files:
            if key != SCALARS:
                index, _, name = key.partition("/")
                rows[int(index)][name] = found[key]
    return rows
