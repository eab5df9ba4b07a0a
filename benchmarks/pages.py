"""Measured parts of a page of the documentation, between marks; the text around them is kept."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path


def put(page: Path, parts: Mapping[str, str]) -> None:
    """Write every text between ``<!-- NAME -->`` and ``<!-- /NAME -->``.

    Parameters
    ----------
    page : Path
    parts : mapping of str to str
        Markdown by name.

    Raises
    ------
    SystemExit
        When the page has no such marks.
    """
    text = page.read_text(encoding="utf-8")
    for name, content in parts.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
        marked, block = rf"{re.escape(begin)}.*?{re.escape(end)}", f"{begin}\n{content}\n\n{end}"
        text, found = re.subn(marked, lambda _, block=block: block, text, flags=re.DOTALL)
        if not found:
            raise SystemExit(f"{page.name}: no place for the {name}: the marks {begin.strip()} are missing")
    page.write_text(text, encoding="utf-8")
