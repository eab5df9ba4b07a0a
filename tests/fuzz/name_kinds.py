"""Names that lead elsewhere or cannot be shown: of files, inputs, recipes."""

import os
from pathlib import Path

import numpy as np
import yaml

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of

ODD = (
    "..", ".", "../../escape", "/tmp/irlos-escape", "a/b", "a//b", "~root", "$HOME", "-rf", "--help", "a b",
    "a\nb", "a\tb", "a'b\"c", "%s%n", "{x}", "<script>alert(1)</script>", "\x1b[31mred", "\u202egnp", "ł€😀",
    "n" * 250, "NUL", "COM1", "a=b", "results.json", "..\\..\\x", "arrays", "*", "a\0b", "\udcff\udcfe", "",
)  # fmt: skip
PRINTABLE = [name for name in ODD if "\0" not in name]


@kind
def file_name(folder: Path, rng: np.random.Generator) -> Case:
    """Name a recorder folder and its file oddly."""
    names = [
        name for name in PRINTABLE if name.strip("./") and "/" not in name and len(os.fsencode(name)) < 240
    ]
    name = pick(rng, names)
    path = pristine.write("recorder", folder / "in" / "sky")
    path.rename(path.with_name(f"{name}.fits"))
    (folder / "in" / "sky").rename(folder / "in" / name)
    pristine.write_recipe(folder)
    return Case(f"file {name!r}", run_of(folder), "recorder")


@kind
def recipe_name(folder: Path, rng: np.random.Generator) -> Case:
    """Name input, recipe or star oddly."""
    pristine.write("recorder", folder / "in" / "sky")
    name = pick(rng, list(ODD))
    content = {"recipe": "fuzz", "inputs": {"cube": "in"}, "stages": ["ingest"]}
    content |= pick(
        rng,
        [
            {"inputs": {name: "in"}},
            {"recipe": name, "title": name},
            {"inputs": {"cube": name}},
            {"instrument": name},
            {"stages": [name]},
            {"ingest": {"acquisition": {"target": name}}},
        ],
    )
    (folder / "recipe.yaml").write_text(yaml.safe_dump(content))
    return Case(f"{content}", run_of(folder), "recorder")


@kind
def argument(folder: Path, rng: np.random.Generator) -> Case:
    """Give odd paths where a command expects a file or a folder."""
    inside = [str(folder), str(folder / ("n" * 300)), "", str(folder / "no such")]
    places = ["/dev/null", "/dev/zero", "/proc/self/mem", "/", *inside, "\udcff", *PRINTABLE]
    place = pick(rng, places)
    commands = [
        *((command, place) for command in ("show", "status", "report", "validate", "export")),
        ("score", place, "--truth", place),
        ("simulate", place, "--output", str(folder / "out")),
        ("run", place, "--output", str(folder / "out")),
    ]
    return Case(f"argument {place[:60]!r}", pick(rng, commands))
