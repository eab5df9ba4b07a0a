"""Find what a name means."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import aligned, suggestion
from irlos_pipe.reference.entries import Entry, all_entries


def explain(name: str) -> str:
    """Return what a stage, key, effect, check, number, array or term called `name` means.

    Raises
    ------
    ConfigurationError
        When nothing is called so.
    """
    entries = all_entries()
    wanted = name.strip().removeprefix("stages.")
    found = [entry for entry in entries if entry.is_called(wanted)]
    if not found:
        known = {part for entry in entries for part in (entry.name, entry.name.rpartition(".")[2])}
        raise ConfigurationError(f"{name}: nothing is called so{suggestion(wanted, sorted(known))}")
    return "\n\n".join(_shown(entry, entries) for entry in found)


def overview() -> str:
    """Return the names of all stages, effects and checks, with their summaries."""
    entries = [one for one in all_entries() if one.kind in ("stage", "effect", "check")]
    return "\n\n".join(_table(list(group)) for _, group in groupby(entries, key=lambda one: one.kind))


def _shown(entry: Entry, entries: Sequence[Entry]) -> str:
    """An entry in full; below a stage, what belongs to it in a line each."""
    first, *rest = entry.text.splitlines()
    text = "\n".join([f"{entry.name} ({entry.kind})", f"  {first}", *(f"  {line}".rstrip() for line in rest)])
    inner = [one for one in entries if one.name.startswith(f"{entry.name}.")]
    kinds = ("key of a recipe", "key of a side-car", "check", "number", "array of a product")
    groups = [[one for one in inner if one.kind == kind] for kind in kinds]
    return "\n\n".join([text, *(_table(group) for group in groups if group)])


def _table(entries: Sequence[Entry]) -> str:
    rows = aligned([(f"  {entry.name}", entry.summary) for entry in entries])
    return f"{entries[0].kind}:\n{rows}"
