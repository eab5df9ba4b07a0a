"""Arrows point one way: which package may import which, written down and checked."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from helpers.paths import PACKAGE

# Package: the other packages it may import. A longer name is a part of a package with rules of its own.
MAY_IMPORT = {
    "conventions": set(),
    "files": {"conventions"},
    "instrument": {"conventions", "files"},
    "frames": {"conventions"},
    "readers": {"conventions", "files", "frames", "instrument"},
    "numerics": {"conventions"},
    "control": {"conventions"},
    "optics": {"conventions", "numerics"},
    "effects": {"conventions", "numerics", "optics"},
    "estimate": {"conventions", "frames", "numerics", "optics", "effects"},
    "diagnosis": {
        "conventions", "frames", "numerics", "optics", "effects", "estimate", "diagnosis.records",
    },
    # What results.json holds of a diagnosis, for those who read it without the science.
    "diagnosis.records": {"conventions"},
    # The simulator shares no line of optics with the model that is fitted to its images.
    "simulate": {"conventions"},
    "simulate.recordings": {"conventions", "effects", "files", "instrument", "product", "simulate"},
    "product": {"conventions", "files"},
    "stages": {
        "conventions", "files", "frames", "instrument", "readers", "numerics", "optics", "effects",
        "estimate", "diagnosis", "diagnosis.records", "product",
    },
    "recipe": {"conventions", "files", "instrument", "readers", "stages"},
    "reference": {"conventions", "effects", "files", "instrument", "product", "readers", "recipe", "stages"},
    "report": {
        "conventions", "files", "frames", "instrument", "numerics", "optics", "effects", "estimate",
        "diagnosis.records", "product", "stages",
    },
    "pipeline": {"conventions", "files", "numerics", "product", "recipe", "stages", "report"},
    "paper": {
        "conventions", "files", "frames", "instrument", "numerics", "optics", "effects", "estimate",
        "control", "simulate", "product", "stages", "report",
    },
    "paper.run": {"conventions", "files", "product", "recipe", "stages", "report", "paper", "pipeline"},
    "night": {
        "conventions", "files", "frames", "readers", "instrument", "product", "recipe", "stages", "report",
        "pipeline",
    },
    "focus": {
        "conventions", "files", "control", "frames", "readers", "instrument", "estimate", "product", "recipe",
        "stages",
    },
    "commands": {
        "conventions", "files", "simulate.recordings", "product", "recipe", "pipeline", "report", "paper.run",
        "night", "instrument", "readers", "reference", "control", "estimate", "focus",
    },
    "api": {
        "conventions", "files", "frames", "instrument", "readers", "product", "stages", "recipe", "pipeline",
        "report",
    },
    "esorex": {"conventions", "pipeline", "recipe"},
    "__main__": {"commands"},
}  # fmt: skip
# Science knows no files, no HDF5, no YAML and no command line: this is all it may use.
SCIENCE = (
    "conventions", "control", "frames", "numerics", "optics", "effects", "estimate", "diagnosis",
    "diagnosis.records", "simulate",
)  # fmt: skip
SCIENCE_MAY_USE = {
    "__future__", "abc", "collections", "concurrent", "contextlib", "contextvars", "copy", "dataclasses",
    "difflib", "enum", "functools", "hashlib", "importlib", "inspect", "itertools", "math", "textwrap",
    "threading", "time", "typing", "warnings", "numpy", "scipy", "torch",
}  # fmt: skip
# Budget of lines of each package. It should only fall: a feature that needs more raises it and says why.
LINES = {
    "api": 540, "commands": 1920, "control": 490, "conventions": 1000, "diagnosis": 5315, "effects": 4080,
    "esorex": 100, "estimate": 7005, "files": 1040, "focus": 2360, "frames": 1980, "instrument": 850,
    "night": 3340, "numerics": 1000, "optics": 3700, "paper": 5440, "pipeline": 1200, "product": 2420,
    "readers": 2490, "recipe": 390, "reference": 280, "report": 4100, "simulate": 4140, "stages": 6170,
}  # fmt: skip
# A package's own __init__ may be empty; the one of the whole comes first and imports nothing.
MODULES = sorted(path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.py"))


@cache
def imported(module: Path) -> tuple[str, ...]:
    """The absolute names of all that a module imports, wherever in the file."""
    return tuple(imports(text(module), module))


def imports(source: str, module: Path) -> Iterator[str]:
    package = module.parent.parts
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *filter(None, [node.module])])
            # "from irlos_pipe import optics" names a package, not something inside one.
            yield from (f"{base}.{alias.name}" for alias in node.names) if base == PACKAGE.name else [base]


def may_import(home: str, name: str) -> bool:
    if name.split(".")[0] != PACKAGE.name:
        return home not in SCIENCE or name.split(".")[0] in SCIENCE_MAY_USE
    return part(name) in {"", home, *MAY_IMPORT[home]}


def text(module: Path) -> str:
    return (PACKAGE.parent / module).read_text()


def dotted(module: Path) -> str:
    return ".".join(module.with_suffix("").parts).removesuffix(".__init__")


def part(name: str) -> str:
    """Longest entry of the list that a dotted name lies in."""
    inside = name.removeprefix(PACKAGE.name).removeprefix(".")
    fits = [known for known in MAY_IMPORT if f"{inside}.".startswith(f"{known}.")]
    return max(fits, key=len, default=inside)


def test_the_list_has_no_circle():
    assert set(TopologicalSorter(MAY_IMPORT).static_order()) == set(MAY_IMPORT)


def test_modules_import_each_other_without_a_circle_annotations_included():
    known = {dotted(module) for module in MODULES}
    graph = {dotted(m): {n for n in imported(m) if n in known and n != dotted(m)} for m in MODULES}
    assert len(list(TopologicalSorter(graph).static_order())) == len(known)


def test_every_module_belongs_to_a_package_of_the_list():
    unknown = {dotted(module) for module in MODULES if part(dotted(module)) not in {"", *MAY_IMPORT}}
    assert unknown == set(), f"say in MAY_IMPORT where {unknown} belong"


@pytest.mark.parametrize("module", MODULES[1:], ids=str)
def test_a_module_imports_only_what_its_package_may(module):
    home = part(dotted(module))
    assert [name for name in imported(module) if not may_import(home, name)] == []


@pytest.mark.parametrize("package", LINES)
def test_a_package_keeps_to_its_lines(package):
    lines = sum(len(text(module).splitlines()) for module in MODULES if module.parts[1] == package)
    assert lines <= LINES[package], "take lines away, or raise LINES and say why in the commit"


def test_every_package_has_its_lines():
    assert {module.parts[1] for module in MODULES if len(module.parts) > 2} == set(LINES)


def test_only_the_commands_know_click():
    users = {module.parent.name for module in MODULES if "click" in imported(module)}
    assert users == {"commands"}
