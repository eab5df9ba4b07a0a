"""Products and folders of runs: damaged, with links to elsewhere, with sections that make no sense."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of
from fuzz.damage import damaged

PRODUCT = "01_ingest.h5"
SECTIONS = ("results", "checks", "config", "provenance", "log")
ODD_JSON = (
    "", "{}", "[]", "null", "1", '"x"', "{", "[" * 5000, '{"key": 1}', '[{"name": 1}]', '{"a": NaN}',
    '{"inputs": 3}', '{"inputs": [{}]}', "[null]", '{"summary": 1, "failures": 2, "key": 3, "parts": 4}',
    '{"stages": {"../../x": 1}}', '{"stages": []}', "1e999", "9" * 5000,
)  # fmt: skip


@kind
def product_bytes(folder: Path, rng: np.random.Generator) -> Case:
    """Damage the bytes of a product."""
    run = pristine.write_run(folder)
    how, content = damaged((run / PRODUCT).read_bytes(), rng)
    (run / PRODUCT).write_bytes(content)
    return _looked_at(run, folder, f"product: {how}", rng)


@kind
def product_links(folder: Path, rng: np.random.Generator) -> Case:
    """Let a product point to other files or to itself, or announce more than it holds."""
    run = pristine.write_run(folder)
    _unseal(run / PRODUCT)
    (folder / "secret.txt").write_text("secret" * 100)
    how = pick(rng, list(LINKS))
    with h5py.File(run / PRODUCT, "r+") as file:
        name = pick(rng, ["results", "provenance", "arrays/extra", "log", "arrays"])
        if name in file and how != MANY:
            del file[name]
        LINKS[how](file, name, folder)
    return _looked_at(run, folder, how, rng)


@kind
def product_sections(folder: Path, rng: np.random.Generator) -> Case:
    """Write a whole product whose JSON makes no sense."""
    run = pristine.write_run(folder)
    _unseal(run / PRODUCT)
    section, text = pick(rng, list(SECTIONS)), pick(rng, list(ODD_JSON))
    with h5py.File(run / PRODUCT, "r+") as file:
        del file[section]
        file[section] = text
        if rng.random() < 0.3:
            file.attrs[pick(rng, ["schema", "schema_version", "stage"])] = pick(
                rng, ["x", 7, 1e99, b"\xff", [1, 2]]
            )
    return _looked_at(run, folder, f"{section} = {text[:40]}", rng)


@kind
def run_files(folder: Path, rng: np.random.Generator) -> Case:
    """Damage the files beside the products."""
    run = pristine.write_run(folder)
    names = sorted(path.name for path in run.iterdir() if path.name != PRODUCT)
    path = run / pick(rng, names)
    how, content = damaged(path.read_bytes(), rng)
    if path.suffix == ".json" and rng.random() < 0.5:
        how, content = "odd JSON", pick(rng, list(ODD_JSON)).encode()
    path.write_bytes(content)
    return _looked_at(run, folder, f"{path.name}: {how}", rng)


def _external_link(file: h5py.File, name: str, folder: Path) -> None:
    with h5py.File(folder / "other.h5", "w") as other:
        other["x"] = "{}"
    file[name] = h5py.ExternalLink(str(folder / "other.h5"), "/x")


def _outside_storage(file: h5py.File, name: str, folder: Path) -> None:
    """Data in another file, as HDF5 allows."""
    file.create_dataset(name, (600,), "u1", external=[(str(folder / "secret.txt"), 0, 600)])


def _virtual(file: h5py.File, name: str, folder: Path) -> None:
    layout = h5py.VirtualLayout((600,), "u1")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "x", (600,))
    file.create_virtual_dataset(name, layout)


def _huge(file: h5py.File, name: str, folder: Path) -> None:
    """An array of terabytes of which nothing is stored."""
    file.create_dataset(name, (10**6, 10**6), "f8", chunks=(1000, 1000)).attrs.update(unit="", description="")


def _linked(link: Callable[[h5py.File, str], Any]) -> Callable[[h5py.File, str, Path], None]:
    return lambda file, name, folder: file.__setitem__(name, link(file, name))


MANY = "many"  # names for one array, thousands of them; nothing is replaced
LINKS: dict[str, Callable[[h5py.File, str, Path], None]] = {
    "external link": _external_link,
    "link to no hdf5": _linked(lambda file, name: h5py.ExternalLink("/etc/passwd", "/x")),
    "link to device": _linked(lambda file, name: h5py.ExternalLink("/dev/zero", "/x")),
    "soft loop": _linked(lambda file, name: h5py.SoftLink(f"/{name}")),
    "hard loop": _linked(lambda file, name: file["/"]),
    "outside storage": _outside_storage,
    "virtual": _virtual,
    "huge": _huge,
    MANY: lambda file, name, folder: file["arrays"].update(
        {f"copy{number}": file["log"] for number in range(3000)}
    ),
    "other type": _linked(lambda file, name: np.zeros(3, [("a", "f4"), ("b", "S5")])),
}


def _unseal(product: Path) -> None:
    """Take off the checksum in front, as whoever forges a product would."""
    content = product.read_bytes()
    product.write_bytes(content[content.index(b"\x89HDF\r\n\x1a\n") :])


def _looked_at(run: Path, folder: Path, summary: str, rng: np.random.Generator) -> Case:
    """Look at the run with one of the commands that read products."""
    array = ("--array", "recordings/cube/sky/images_e")
    export = ("export", str(run / PRODUCT), *array, "--output", str(run / "out.fits"))
    again = run_of(folder)
    commands = [("show", str(run / PRODUCT)), ("status", str(run)), ("report", str(run)), export, again]
    command = pick(rng, commands)
    return Case(summary, command, "recorder" if command is again else "")
