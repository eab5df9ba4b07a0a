"""The reference pages of the documentation, made from what `irlos explain` shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from irlos_pipe.conventions.errors import EXIT_MEANINGS
from irlos_pipe.effects.catalogue import catalogue_page
from irlos_pipe.files.shipped import RECIPES, SIMULATIONS, shipped_folder, shipped_names
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.reference import COMMANDS, RESULTS
from irlos_pipe.reference.lookup import GLOSSARY, Entry, all_entries
from irlos_pipe.stages import LIGHT_PATH

_KEYS = (
    "Every key with its default, as `irlos explain KEY` tells it. Any of them can be given on the command "
    "line as `--set SECTION.KEY=VALUE`; the command line wins over the recipe, the recipe over its "
    "defaults."
)
_SIDECAR = (
    "A side-car `acquisition.yaml` states what a recording cannot say; `irlos sidecar FITS` writes one to "
    "be filled in. A recipe may hold the same keys under `ingest.acquisition`, which win over side-cars; "
    "what neither states comes from the header, then from the instrument profile."
)
_CHECKS = "A value out of its limits makes the exit code 4. `qc.json` of a run holds all of them."
_PRODUCTS = (
    "A stage leaves one HDF5 file, `NN_<stage>.h5`. `/arrays/<name>` are the arrays, with the attributes "
    "`unit` and `description`; `/errors/<name>` their standard errors, where there are any (±). "
    "`/results`, `/checks`, `/config` and `/provenance` are JSON, `/log` are lines. `irlos show` lists a "
    "product, `irlos export` and `irlos_pipe.read_product` take arrays out of it."
)
_RESULTS = (
    "What stands under `stages` in `results.json`, by stage. Units are in the names. NaN is null. Keys "
    "that a run has nothing to say about are left out. [The schema](schema.md) checks a file."
)
_SCHEMA = (
    "Also in the package, as `irlos_pipe/reference/results.schema.json`, and by `irlos explain --schema`."
)
_SCHEMA_COMMANDS = (
    "`irlos status`, `show`, `validate`, `score` and `compare` print JSON with `--json`: one object, whose "
    "key `schema` says what it is. The exit code is the same as without. Numbers that are not known are "
    "null, and no key is left out. Also in the package, as `irlos_pipe/reference/commands.schema.json`, and "
    "by `irlos explain --schema commands`."
)


def pages() -> dict[str, str]:
    entries = all_entries()
    return {
        "recipes": _recipes(),
        "keys": _by_section("Keys of recipes", _of(entries, "key of a recipe"), _KEYS),
        "sidecar": _one_table("Keys of side-cars", _of(entries, "key of a side-car"), _SIDECAR),
        "profile": _profile(entries),
        "checks": _by_section("Quality checks", _of(entries, "check"), _CHECKS),
        "products": _by_section("Products and their arrays", _of(entries, "array of a product"), _PRODUCTS),
        "results": _by_section("results.json", _of(entries, "number"), _RESULTS),
        "schema": _schema("results.json", _SCHEMA, RESULTS),
        "schema_commands": _schema("what commands print", _SCHEMA_COMMANDS, COMMANDS),
        "exit_codes": _exit_codes(),
        "effects": catalogue_page(),
        "glossary": GLOSSARY.read_text(encoding="utf-8"),
    }


def _schema(what: str, lead: str, file: Path) -> str:
    return f"# JSON Schema of {what}\n\n{lead}\n\n```json\n{file.read_text(encoding='utf-8')}```\n"


def _of(entries: Iterable[Entry], *kinds: str) -> list[Entry]:
    return [entry for entry in entries if entry.kind in kinds]


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", "<br>").replace("<", "&lt;").replace("&lt;br>", "<br>")


def _table(entries: Sequence[Entry], drop: str = "") -> str:
    rows = []
    for entry in entries:
        first, *rest = entry.text.splitlines()
        rest = [line for line in rest if line != "in results.json under stages"]
        rows.append(f"| `{entry.name.removeprefix(drop)}` | {_cell(first)} | {_cell(chr(10).join(rest))} |")
    return "\n".join(["| name | what it is | value, unit, limits |", "|---|---|---|", *rows])


def _one_table(title: str, entries: Sequence[Entry], lead: str) -> str:
    return f"# {title}\n\n{lead}\n\n{_table(entries)}\n"


def _by_section(title: str, entries: Sequence[Entry], lead: str) -> str:
    """One table for every part before the first dot, stages in the order of the light path."""
    parts = list(dict.fromkeys(entry.name.partition(".")[0] for entry in entries if "." in entry.name))
    order = [*(p for p in parts if p not in LIGHT_PATH), *(p for p in LIGHT_PATH if p in parts)]
    text = [f"# {title}", lead]
    top = [entry for entry in entries if "." not in entry.name]
    text += ["## At the top", _table(top)] if top else []
    for part in order:
        inside = [entry for entry in entries if entry.name.startswith(f"{part}.")]
        text += [f"## {part}", _table(inside, f"{part}.")]
    return "\n\n".join(text) + "\n"


def _profile(entries: Sequence[Entry]) -> str:
    keys, facts = _of(entries, "key of a profile"), _of(entries, "fact of a profile")
    return "\n\n".join(
        [
            "# Instrument profiles",
            "What a profile may state; [how to write one](../instruments.md) has an example.",
            "## Sections",
            _table(keys, "profile."),
            "## Facts",
            _table(facts, "profile.facts."),
        ]
    )


def _recipes() -> str:
    text = ["# Recipes and specifications", "`irlos recipes NAME` prints one, to be copied and changed."]
    for title, kind in (("Recipes", RECIPES), ("Specifications of simulations", SIMULATIONS)):
        rows = []
        for name in shipped_names(kind):
            content = load_yaml(shipped_folder(kind) / f"{name}.yaml")[0]
            inputs, stages = (", ".join(content.get(key, ())) for key in ("inputs", "stages"))
            rows.append(f"| `{name}` | {content['title']} | {inputs} | {stages} |")
        text += [f"## {title}", "\n".join(["| name | | inputs | stages |", "|---|---|---|---|", *rows])]
    return "\n\n".join(text) + "\n"


def _exit_codes() -> str:
    rows = [f"| {code.value} | {text} |" for code, text in EXIT_MEANINGS.items()]
    return "\n".join(["# Exit codes", "", "| code | meaning |", "|---|---|", *rows, ""])
