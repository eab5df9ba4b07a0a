"""The unspoiled inputs, and what the pipeline makes of them; each made once per process."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from astropy.io import fits
from helpers import sparta_files

from irlos_pipe.pipeline import run_recipe
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import load_recipe
from irlos_pipe.stages.ingest.stage import recordings_from_product

ROWS, COLUMNS, FRAMES = 24, 20, 8
RECIPE = "recipe: fuzz\ninputs:\n  cube: {path}\nstages: [ingest]\n"
FOLDER = b"@FOLDER@"


@dataclass(frozen=True)
class Measured:
    """What ingest makes of a recording, (rows, columns) each."""

    mean_e: np.ndarray  # mean of the used frames [e-]
    mask: np.ndarray  # True for good pixels


@cache
def adu() -> np.ndarray:
    """Counts (frames, rows, columns) of a star."""
    return sparta_files.counts(sparta_files.star(ROWS, COLUMNS), frames=FRAMES)


@cache
def dark() -> np.ndarray:
    """Level without light (rows, columns) [ADU]."""
    return np.full((ROWS, COLUMNS), 50.0, np.float32)


def write(name: str, folder: Path) -> Path:
    """Write a recording of one layout (recorder, cube, muse) into a folder; returns its data file."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == "recorder":
        times = {"Seconds": 1689304870 + np.arange(FRAMES), "USeconds": np.zeros(FRAMES, int)}
        return sparta_files.write_recorder(folder, adu(), pad=7, times=times, maps={"DARK": dark()})
    sparta_files.write_sidecar(folder / "acquisition.yaml")
    path = folder / f"{name}.fits"
    if name == "cube":
        fits.writeto(path, adu())
        return path
    return sparta_files.write_muse(path, adu(), seeing=[0.6, 0.7, 0.8])


def write_recipe(folder: Path) -> Path:
    """Write a recipe that ingests what lies in the folder ``in`` beside it."""
    recipe = folder / "recipe.yaml"
    recipe.write_text(RECIPE.format(path="in"))
    return recipe


def measured(product: Path) -> Measured:
    """Read what ingest made of the only recording in its product."""
    (recording,) = recordings_from_product(read_product(product))
    images = recording.accepted().images_e
    return Measured(images.mean(axis=0, dtype=np.float64), recording.good)


@cache
def reference(name: str) -> Measured:
    """What ingest makes of an unspoiled recording."""
    with _finished_run(name) as folder:
        return measured(folder / "out" / "01_ingest.h5")


@cache
def run_files() -> dict[str, bytes]:
    """Every file of a finished run on the recorder's recording, by name; `FOLDER` stands for its place."""
    with _finished_run("recorder") as folder:
        place = str(folder).encode()
        files = [path for path in (folder / "out").iterdir() if path.is_file() and path.stat().st_size]
        content = {path: path.read_bytes() for path in files}  # products name no place of inputs
        return {
            path.name: one if path.suffix == ".h5" else one.replace(place, FOLDER)
            for path, one in content.items()
        }


def write_run(folder: Path) -> Path:
    """Write a finished run and its inputs; returns the folder of the run."""
    write("recorder", folder / "in" / "sky")
    write_recipe(folder)
    (folder / "out").mkdir()
    for name, content in run_files().items():
        (folder / "out" / name).write_bytes(content.replace(FOLDER, str(folder).encode()))
    return folder / "out"


@contextmanager
def _finished_run(name: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(name, folder / "in" / "sky")
        run_recipe(load_recipe(write_recipe(folder)), folder / "out")
        yield folder
