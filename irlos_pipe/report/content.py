"""What a report is made of: sections of figures, tables and notes; no HTML here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from markupsafe import Markup

Width = Literal["third", "half", "two-thirds", "full"]
MOST_CHOICES = 4


@dataclass(frozen=True)
class Figure:
    """A drawing with its title and caption.

    Attributes
    ----------
    width : Width
        Room it takes on a wide screen: a third, half or two thirds of the page, or all of it. A telephone
        shows one after the other; ``full`` can be pushed sideways there.
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
    prose : bool
        Whether cells hold sentences, which are broken into lines.
    """

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""
    marks: Sequence[str] = ()
    folded: bool = False
    prose: bool = False


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


@dataclass(frozen=True)
class Views:
    """The same content in several ways, of which a page shows the one that the reader chooses.

    Attributes
    ----------
    name : str
        Unique in the page.
    choices : mapping of str to sequence of blocks
        By what the reader clicks; the first is shown at the beginning.
    width : Width
        Room that all blocks of a choice take together.
    """

    kind: ClassVar[str] = "views"
    name: str
    choices: Mapping[str, Sequence[Block]]
    width: Width = "full"

    def __post_init__(self) -> None:
        if len(self.choices) > MOST_CHOICES:
            raise ValueError(f"{len(self.choices)} choices; report.css has rules for {MOST_CHOICES}")


Block = Figure | Table | Text | Stack | Views


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
