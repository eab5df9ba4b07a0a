"""Side-cars, recipes, instrument profiles and simulation specs: slips of the pen, damage."""

import re
from pathlib import Path

import numpy as np
import yaml

from fuzz import pristine
from fuzz.case import Case, kind, pick, run_of
from fuzz.damage import damaged

ROOT = Path(__file__).parents[2]
PROFILE = ROOT / "irlos_pipe" / "instrument" / "irlos.yaml"
RECIPES = sorted((ROOT / "recipes").glob("*.yaml"))
SPECS = sorted((ROOT / "recipes" / "simulations").glob("*.yaml"))
WORD = re.compile(r"[\w.+-]+")
ABSURD = (
    "", "null", "~", "true", "-1", "0", "1e-3", "1e400", "-1e400", ".nan", ".inf", "9" * 30, "9" * 5000,
    "0x7f", "0o17", "1:60:60", "2021-99-99", "2021-03-20", "12:30", "[]", "{}", "[1, [2, [3]]]",
    "{a: {b: c}}", "yes", "'", '"', '"\\0"', '"\\ud800"', '"\\x1b[2J"', "\u202e", "ł€",
    "!!python/object/apply:os.system [id]", "!x y", "!!binary aGVsbG8=", "!!int x", "&a 1", "*a", "<<",
    "? [1, 2]", "- x", "%TAG", "---", "...", "@", "`", "|", "../../../../etc/passwd", "/dev/zero",
    "/dev/stdin", "a" * 5000, "null: null", "#", "\t", "=",
)  # fmt: skip
SETTINGS = [
    "ingest.flux_sigma", "ingest.acquisition", "ingest.acquisition.spectrum", "model.effects", "seed",
    "stages", "ingest", "", ".", "a.b.c", "stages.0", "inputs.cube", "ingest.0.0",
]  # fmt: skip


@kind
def sidecar(folder: Path, rng: np.random.Generator) -> Case:
    """Spoil the side-car of a recording."""
    pristine.write("recorder", folder / "in" / "sky")
    summary = _spoil(folder / "in" / "sky" / "acquisition.yaml", rng)
    arguments = run_of(folder, recipe=pristine.write_recipe(folder))
    return Case(f"side-car: {summary}", arguments, "recorder", plausible=True)


@kind
def recipe(folder: Path, rng: np.random.Generator) -> Case:
    """Spoil one of the project's recipes, and check or plan it."""
    source = pick(rng, RECIPES)
    path = _copy(source, folder / "recipes")
    pristine.write("cube", folder / "in")
    names = yaml.safe_load(source.read_text())["inputs"]
    inputs = [f"--input={name}={folder / 'in'}" for name in names]
    summary = _spoil(path, rng)
    arguments = pick(rng, [("validate", str(path)), run_of(folder, "--dry-run", recipe=path)])
    return Case(f"{source.name}: {summary}", (*arguments, *inputs))


@kind
def setting(folder: Path, rng: np.random.Generator) -> Case:
    """Give options of the command line odd keys and values."""
    pristine.write("cube", folder / "in")
    text = f"{pick(rng, SETTINGS)}{pick(rng, ['=', '=', '=', ''])}{pick(rng, list(ABSURD))}"
    option = pick(rng, ["--set", "--set", "--input", "--from", "--seed"])
    return Case(
        f"{option} {text[:60]}", run_of(folder, f"{option}={text}", recipe=pristine.write_recipe(folder))
    )


@kind
def profile(folder: Path, rng: np.random.Generator) -> Case:
    """Spoil an instrument profile."""
    pristine.write("cube", folder / "in")
    path = _copy(PROFILE, folder)
    summary = _spoil(path, rng)
    recipe = pristine.write_recipe(folder)
    recipe.write_text(f"{recipe.read_text()}instrument: ./irlos.yaml\n")
    return Case(f"profile: {summary}", run_of(folder, recipe=recipe))


@kind
def spec(folder: Path, rng: np.random.Generator) -> Case:
    """Spoil a simulation spec, and plan it."""
    source = pick(rng, SPECS)
    path = _copy(source, folder)
    summary = _spoil(path, rng)
    return Case(
        f"{source.name}: {summary}", ("simulate", str(path), "--output", str(folder / "out"), "--dry-run")
    )


def _copy(source: Path, folder: Path) -> Path:
    folder.mkdir(exist_ok=True, parents=True)
    path = folder / source.name
    path.write_bytes(source.read_bytes())
    return path


def _spoil(path: Path, rng: np.random.Generator) -> str:
    """Spoil a YAML file in one of several ways; returns what was done."""
    if rng.random() < 0.3:
        how, content = damaged(path.read_bytes(), rng)
        path.write_bytes(content)
        return how
    how = pick(rng, [_other_tokens, _other_lines, _other_value])
    summary, text = how(path.read_text(), rng)
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    return summary


def _other_tokens(text: str, rng: np.random.Generator) -> tuple[str, str]:
    """Replace one to three words by absurd ones."""
    summary = []
    for _ in range(rng.integers(1, 4)):
        places = [found.span() for found in WORD.finditer(text)]
        start, end = pick(rng, places)
        value = pick(rng, list(ABSURD))
        summary.append(f"{text[start:end]} -> {value[:30]!r}")
        text = text[:start] + value + text[end:]
    return ", ".join(summary), text


def _other_lines(text: str, rng: np.random.Generator) -> tuple[str, str]:
    """Drop, repeat, move or indent a line."""
    lines = text.splitlines()
    here, there = (int(place) for place in rng.integers(len(lines), size=2))
    line = lines[here]
    how = pick(rng, ["drop", "repeat", "move", "indent"])
    if how in ("drop", "move"):
        lines.pop(here)
    if how in ("repeat", "move"):
        lines.insert(there, line)
    if how == "indent":
        lines[here] = pick(rng, [" ", "  ", "\t"]) + line
    return f"{how} line {here + 1}", "\n".join(lines) + "\n"


def _other_value(text: str, rng: np.random.Generator) -> tuple[str, str]:
    """Replace a value somewhere in the tree by one of another type."""
    tree = yaml.safe_load(text)
    node, key = tree, pick(rng, list(tree))
    while isinstance(node[key], (dict, list)) and node[key] and rng.random() < 0.8:
        node = node[key]
        key = pick(rng, list(node if isinstance(node, dict) else range(len(node))))
    node[key] = pick(rng, [None, True, -1, 0, 1e300, "x", [], {}, [[]], {"a": 1}, ["x"] * 50, "\0", 10**40])
    return f"{key} = {node[key]!r}"[:60], yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
