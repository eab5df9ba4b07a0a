"""What a report is made of: sections of figures, tables and notes; no HTML here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from markupsafe import Markup

Width = Literal["third", "half", "full"]


@dataclass(frozen=True)
class Figure:
    """A drawing with its title and caption.

    Attributes
    ----------
    width : Width
        Room it takes on a wide screen: a third or half of the page, or all of it. A telephone shows
        one after the other; ``full`` can be pushed sideways there.
    """

    kind: ClassVar[str] = "figure"
    svg: Markup
    title: str
    caption: str = ""
    width: Width = "half"


@dataclass(frozen=True)
class Table:
    """Rows of text under column names.

    Attributes
    ----------
    marks : sequence of str
        Per row ``good``, ``bad`` or nothing; may be empty.
    folded : bool
        Shown by its title only until opened.
    """

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""
    marks: Sequence[str] = ()
    folded: bool = False


@dataclass(frozen=True)
class Text:
    """A sentence, or lines of a file as they are."""

    kind: ClassVar[str] = "text"
    text: str
    title: str = ""
    verbatim: bool = False
    folded: bool = False


@dataclass(frozen=True)
class Stack:
    """Blocks below one another that together take half of the page."""

    kind: ClassVar[str] = "stack"
    blocks: Sequence[Block]


Block = Figure | Table | Text | Stack


@dataclass(frozen=True)
class Section:
    """A part of the report with a heading; `lead` states in one line what was done."""

    name: str
    title: str
    lead: str = ""
    blocks: Sequence[Block] = ()


@dataclass(frozen=True)
class KeyNumber:
    """A number for the top of the report, as text with its unit."""

    label: str
    value: str
    note: str = ""
    mark: Literal["", "good", "bad"] = ""
