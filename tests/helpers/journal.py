"""What a long search has tried so far, one line of JSON per trial, so that it can go on where it stopped."""

import json
from pathlib import Path
from typing import Any


class Journal:
    """Entries by key, in a file unless `path` is None; a line that was cut off while written is left out."""

    def __init__(self, path: Path | None):
        self._path = path
        self.entries: dict[str, dict[str, Any]] = {}
        if path is not None and path.is_file():
            text = path.read_text()
            self.entries = {one["key"]: one for one in map(_entry, text.splitlines()) if one}
            path.write_text("".join(f"{json.dumps(one)}\n" for one in self.entries.values()))

    def add(self, key: str, **entry: Any) -> dict[str, Any]:
        self.entries[key] = {"key": key} | entry
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(f"{json.dumps(self.entries[key])}\n")
        return self.entries[key]


def _entry(line: str) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) and "key" in found else {}
