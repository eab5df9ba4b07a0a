"""Arrows point one way: which part of the package may import which, written down and checked."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "irlos_pipe"

# Layer: (its modules and packages, the other layers it may import).
LAYERS = {
    "errors": ({"errors"}, set()),
    "frames": ({"blocks", "recording", "detector", "noise", "bandlimit", "blemishes", "dark_noise",
                "photon_transfer", "screening"},
               {"errors"}),
    "geometry": ({"geometry", "seeing"}, set()),
    "model": ({"optics", "effects", "forward_mode", "psf", "psf_settings", "focus_table", "image_model",
               "parallel"},
              {"errors", "geometry"}),
    # The simulator shares no line of optics with the model that is fitted to its images.
    "simulate": ({"simulate"}, {"errors", "geometry"}),
    "estimate": ({"estimate", "diagnose"}, {"errors", "frames", "geometry", "model"}),
    "experiments": ({"experiments"}, {"errors", "frames", "geometry", "model", "estimate", "simulate"}),
    "files": ({"atomic", "jsonable", "yamlfile", "complaints", "overrides"}, {"errors"}),
    "processes": ({"processes"}, set()),
    "product": ({"product", "seal", "runfolder"}, {"errors", "files"}),
    "instrument": ({"instrument", "instrument_profile"}, {"errors", "files", "geometry"}),
    "reading": ({"sparta", "cleaning"}, {"errors", "files", "frames", "geometry", "instrument"}),
    "campaign": ({"campaign"},
                 {"errors", "files", "geometry", "simulate", "instrument", "processes", "product"}),
    "stages": ({"stages"},
               {"errors", "files", "frames", "geometry", "model", "estimate", "simulate", "experiments",
                "processes", "product", "instrument", "reading", "campaign"}),
    "recipe": ({"recipe"}, {"errors", "files", "instrument", "stages"}),
    "report": ({"report", "score"},
               {"errors", "files", "frames", "geometry", "model", "estimate", "experiments", "product",
                "instrument", "stages"}),
    "pipeline": ({"pipeline"}, {"errors", "files", "model", "product", "recipe", "stages", "report"}),
    "text": ({"terminal", "show", "export"}, {"errors", "files", "product", "recipe", "pipeline"}),
    "paper": ({"paper"},
              {"errors", "files", "product", "recipe", "stages", "report", "pipeline", "text"}),
    "night": ({"night"},
              {"errors", "files", "processes", "product", "instrument", "reading", "recipe", "stages",
               "report", "pipeline", "text"}),
    "commands": ({"cli", "cli_night", "cli_options", "exits", "__main__"},
                 {"errors", "campaign", "product", "recipe", "pipeline", "report", "text", "paper", "night"}),
}
# Science knows no files, no HDF5, no YAML and no command line: this is all it may use.
SCIENCE = ("frames", "geometry", "model", "simulate", "estimate", "experiments")
SCIENCE_MAY_USE = {"__future__", "abc", "collections", "concurrent", "copy", "dataclasses", "difflib", "enum",
                   "functools", "itertools", "math", "threading", "time", "typing", "warnings", "numpy",
                   "scipy", "torch"}
# The package's own __init__ comes first; it imports nothing.
MODULES = sorted(path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.py"))
LAYER_OF = {name: layer for layer, (names, _) in LAYERS.items() for name in names}


def imports(source: str, module: Path) -> Iterator[str]:
    """Yield the absolute names of all that a module imports, wherever in the file."""
    package = module.parent.parts
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *filter(None, [node.module])])
            # "from irlos_pipe import psf" names a module, not something inside one.
            yield from (f"{base}.{alias.name}" for alias in node.names) if base == PACKAGE.name else [base]


def violations(source: str, module: Path) -> list[str]:
    """What a module imports against the allow-list."""
    layer = LAYER_OF[part(".".join(module.with_suffix("").parts))]
    return [name for name in imports(source, module) if not may_import(layer, name)]


def may_import(layer: str, name: str) -> bool:
    if name.split(".")[0] != PACKAGE.name:
        return layer not in SCIENCE or name.split(".")[0] in SCIENCE_MAY_USE
    if part(name) not in LAYER_OF:
        return name == PACKAGE.name
    return LAYER_OF[part(name)] in {layer, *LAYERS[layer][1]}


def text(module: Path) -> str:
    return (PACKAGE.parent / module).read_text()


def part(name: str) -> str:
    """Second component of a dotted name: the module or package within irlos_pipe."""
    return [*name.split("."), ""][1]


def test_the_allow_list_has_no_circle():
    below = {layer: lower for layer, (_, lower) in LAYERS.items()}
    assert set(TopologicalSorter(below).static_order()) == set(LAYERS)


def test_every_module_belongs_to_a_layer():
    parts = {part(".".join(module.with_suffix("").parts)) for module in MODULES}
    unknown = parts - LAYER_OF.keys() - {"__init__"}
    assert unknown == set(), f"say in LAYERS where {unknown} belong"


@pytest.mark.parametrize("module", MODULES[1:], ids=str)
def test_a_module_imports_only_what_its_layer_may(module):
    assert violations(text(module), module) == []


@pytest.mark.parametrize(("source", "module", "expected"), [
    ("import h5py", "irlos_pipe/optics/x.py", ["h5py"]),
    ("from pathlib import Path", "irlos_pipe/psf.py", ["pathlib"]),
    ("from ..estimate import lift", "irlos_pipe/optics/x.py", ["irlos_pipe.estimate"]),
    ("from irlos_pipe import psf, pipeline", "irlos_pipe/estimate/x.py", ["irlos_pipe.pipeline"]),
    ("def f():\n    from irlos_pipe.cli import cli", "irlos_pipe/stages/x.py", ["irlos_pipe.cli"]),
    ("from .base import A\nfrom ..optics.pupil import B\nimport numpy.fft", "irlos_pipe/effects/x.py", []),
])
def test_the_guard_sees_forbidden_imports_and_lets_others_pass(source, module, expected):
    assert violations(source, Path(module)) == expected


def test_only_the_commands_know_click():
    users = {str(module) for module in MODULES if "click" in imports(text(module), module)}
    assert users == {f"irlos_pipe/{name}.py" for name in ("cli", "cli_night", "cli_options", "exits")}
