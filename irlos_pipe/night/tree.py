"""Where the files of a tree of nights lie."""

from __future__ import annotations

from pathlib import Path


def page_path(tree: Path, date: str) -> Path:
    """Return the path in `tree` of the page of the night of a `date`."""
    return tree / f"night_{date}.html"
