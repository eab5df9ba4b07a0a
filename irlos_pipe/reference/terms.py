"""Terms of the field and of this package, from the glossary beside this module."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from irlos_pipe.reference.entry import Entry

GLOSSARY = Path(__file__).with_name("glossary.md")
LINE_LENGTH = 100
TERM = re.compile(r"^\*\*(.+?)\.\*\* (.+?)(?=\n\n|\Z)", re.DOTALL | re.MULTILINE)


def term_entries() -> Iterator[Entry]:
    """Yield every term of the glossary; one called ``A, B`` under both names."""
    for names, text in TERM.findall(GLOSSARY.read_text(encoding="utf-8")):
        lines = textwrap.fill(" ".join(text.split()), LINE_LENGTH)
        for name in [names] if "(" in names else names.split(", "):
            yield Entry("term", name, lines)
