"""Folders: links, pipes, copies and torn files among recordings, outputs of others, spoiled databases."""

import gzip
import os
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from click.testing import CliRunner
from helpers import sparta_files

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of
from fuzz.damage import damaged
from irlos_pipe.commands.main import cli
from irlos_pipe.night.database import NAME

NIGHT_RECIPE = "recipe: fuzz\ninputs: {calibration: in}\nstages: [ingest]\n"
ROWS = (
    "UPDATE recordings SET description = 'x'",
    "UPDATE recordings SET description = '[]'",
    "UPDATE recordings SET description = replace(description, '202', '../..')",
    "UPDATE recordings SET stamp = x'00ff'",
    "UPDATE runs SET effects = '{', verdict = 'effect'",
    "UPDATE runs SET night = '../../x', verdict = 'none', effects = '[]'",
    "UPDATE runs SET start_unix_s = 1e300",
    "UPDATE runs SET run = 'no slash', verdict = 'none'",
    "UPDATE numbers SET value = 'many', sigma = x'00'",
    "INSERT INTO numbers SELECT run, 'noll_9_nm', 'many', NULL FROM runs",
    "INSERT INTO numbers SELECT run, '<script>$', 1e308, -1 FROM runs",
    "DELETE FROM runs",
)
SQL = (
    *ROWS,
    "DROP TABLE numbers",
    "PRAGMA user_version = 99",
    "PRAGMA user_version = -1",
)


@kind
def folder_entries(folder: Path, rng: np.random.Generator) -> Case:
    """Put odd things beside a recording."""
    path = pristine.write("recorder", folder / "in" / "sky")
    done = [_clutter(path, rng) for _ in range(rng.integers(1, 4))]
    (folder / "recipe.yaml").write_text(pristine.RECIPE.format(path="in"))
    return Case(", ".join(done), run_of(folder), "recorder", plausible=True)


@kind
def night_entries(folder: Path, rng: np.random.Generator) -> Case:
    """Reduce a night with odd things in it."""
    path = pristine.write("recorder", folder / "in" / "2023-07-14" / "sky")
    done = [_clutter(path, rng) for _ in range(rng.integers(1, 4))]
    return Case(", ".join(done), _night(folder))


@kind
def output_entries(folder: Path, rng: np.random.Generator) -> Case:
    """Let the output be a folder of somebody else's, or links and pipes wait in that of a run."""
    (folder / "mine").mkdir()
    (folder / "mine" / "notes").write_text("mine")
    if rng.random() < 0.5:
        out = pristine.write_run(folder)
    else:
        pristine.write("recorder", folder / "in" / "sky")
        pristine.write_recipe(folder)
        out = folder / "out"
        out.mkdir()
    names = ["run.log", "results.json", ".input_checksums.json", ".lock", ".partial", "01_ingest.h5",
             "report.html", "qc.json", "recipe.resolved.yaml", "earlier", "thesis.tex"]  # fmt: skip
    done = []
    for name in rng.choice(names, 2, replace=False):
        how = pick(rng, list(IN_OUTPUT))
        _remove(out / str(name))
        IN_OUTPUT[how](out / str(name), folder / "mine")
        done.append(f"{name}:{how}")
    return Case(", ".join(done), run_of(folder), place=True)


@kind
def tree_database(folder: Path, rng: np.random.Generator) -> Case:
    """Spoil the database of a tree, or its rows."""
    pristine.write("recorder", folder / "in" / "2023-07-14" / "sky")
    arguments = _night(folder)
    CliRunner().invoke(cli, arguments)
    path = folder / "out" / NAME
    if rng.random() < 0.3:
        how, content = damaged(path.read_bytes(), rng)
        path.write_bytes(content)
    else:
        how = pick(rng, list(SQL))
        with sqlite3.connect(path) as connection:
            connection.execute(how)
    trend = ("trend", str(folder / "out"), *pick(rng, [(), ("--json",)]))
    return Case(how, pick(rng, [arguments, trend]), place=True)


def _clutter(path: Path, rng: np.random.Generator) -> str:
    """Put one odd thing beside the recording, or change the recording."""
    how = pick(rng, list(CLUTTER))
    name = pick(
        rng, ["a", "z", "sky-2.fits", "acquisition.yaml", "IRAcq.DET1.FLAT.fits", "sky.yaml", "b\nc.fits"]
    )
    target = path.with_name(name)
    if not target.exists() and not target.is_symlink():
        CLUTTER[how](target, path)
    return f"{name!r}:{how}"


def _deep(target: Path, path: Path) -> None:
    folder = target.with_name("deep").joinpath(*["d"] * 60)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(path, folder / path.name)


def _two_tables(_: Path, path: Path) -> None:
    table = sparta_files.pixel_table(pristine.adu())
    fits.HDUList([fits.PrimaryHDU(), table, table.copy()]).writeto(path, overwrite=True)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


Change = Callable[[Path, Path], Any]  # of a place, and the recording beside it or a folder of somebody else's
PLAIN: dict[str, Change] = {
    "_pipe": lambda target, _: os.mkfifo(target),
    "_folder": lambda target, _: target.mkdir(),
    "_noise": lambda target, _: target.write_bytes(bytes(range(256)) * 20),
}
CLUTTER: dict[str, Change] = {
    "_pipe": PLAIN["_pipe"],
    "_device": lambda target, _: target.symlink_to(
        pick(np.random.default_rng(0), ["/dev/zero", "/dev/full", "/dev/tty"])
    ),
    "_loop": lambda target, _: target.symlink_to("."),
    "_upwards": lambda target, _: target.symlink_to("../.."),
    "_nowhere": lambda target, _: target.symlink_to("gone.fits"),
    "_itself": lambda target, _: target.symlink_to(target.name),
    "_second_name": lambda target, path: target.symlink_to(path.name),
    "_copy": lambda target, path: shutil.copy(path, target),
    "_packed_copy": lambda target, path: target.with_name("sky.fits.gz").write_bytes(
        gzip.compress(path.read_bytes())
    ),
    "_header_only": lambda target, path: target.write_bytes(path.read_bytes()[:2880]),
    "_deep": _deep,
    "_two_tables": _two_tables,
    "_folder": PLAIN["_folder"],
    "_noise": PLAIN["_noise"],
}
IN_OUTPUT: dict[str, Change] = {
    "_link_to_file": lambda target, mine: target.symlink_to(mine / "notes"),
    "_link_to_folder": lambda target, mine: target.symlink_to(mine),
    **PLAIN,
}


def _night(folder: Path) -> tuple[str, ...]:
    (folder / "cube.yaml").write_text(NIGHT_RECIPE)
    recipe = f"calibration={folder / 'cube.yaml'}"
    return ("night", str(folder / "in"), "--output", str(folder / "out"), "--recipe", recipe)
