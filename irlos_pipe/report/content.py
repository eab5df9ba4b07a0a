"""What a report is made of: sections of figures, tables and notes, and the template that shows them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

import jinja2
from markupsafe import Markup

Item = TypeVar("Item")
Width = Literal["third", "half", "two-thirds", "full"]


@dataclass(frozen=True)
class Figure:
    """A drawing with its title and caption.

    Its width is the room it takes on a wide screen: a third, half or two thirds of the page, or all of it. A
    telephone shows one after the other; ``full`` can be pushed sideways there.
    """

    kind: ClassVar[str] = "figure"
    svg: Markup
    title: str
    caption: str = ""
    width: Width = "half"
    name: str = ""  # that of the drawing; links in the page lead to it


@dataclass(frozen=True)
class Table:
    """Rows of text under column names."""

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""
    marks: Sequence[str] = ()  # per row ``good``, ``bad`` or nothing; may be empty
    folded: bool = False  # shown by its title only until opened
    prose: bool = False  # whether cells hold sentences, which are broken into lines
    name: str = ""  # links in the page lead to it
    anchors: Sequence[str] = ()  # the same per row; may be empty

    @classmethod
    def of(
        cls,
        items: Iterable[Item],
        columns: Mapping[str, Callable[[Item], str]],
        title: str = "",
        caption: str = "",
        **look: Any,
    ) -> "Table":
        """Return a table with a row for each of the `items`; `columns` say by title what is shown of one."""
        rows = [tuple(cell(item) for cell in columns.values()) for item in items]
        return cls(tuple(columns), rows, title, caption, **look)


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
    blocks: "Sequence[Block]"


@dataclass(frozen=True)
class Views:
    """The same content in several ways, of which a page shows the one that the reader chooses.

    The choices, up to four, for which report.css has rules, are named by what the reader clicks, and the
    first is shown at the beginning; the width is that of all blocks of a choice together. The name is unique.
    """

    kind: ClassVar[str] = "views"
    name: str
    choices: "Mapping[str, Sequence[Block]]"
    width: Width = "full"


Block = Figure | Table | Text | Stack | Views
Blocks = Block | None | Iterable[Block | None]


def walked(blocks: Iterable[Block]) -> Iterator[Block]:
    """Yield `blocks` and those within them."""
    for block in blocks:
        yield block
        if isinstance(block, Stack):
            yield from walked(block.blocks)
        elif isinstance(block, Views):
            yield from walked(inner for choice in block.choices.values() for inner in choice)


def shown(*blocks: Blocks) -> list[Block]:
    """Return `blocks` in one list, without tables that have no rows and what else is nothing."""
    flat = [one for some in blocks for one in (some if isinstance(some, Iterable) else [some])]
    return [one for one in flat if one is not None and not (isinstance(one, Table) and not one.rows)]


@dataclass(frozen=True)
class Section:
    """A part of the report with a heading; `lead` states in one line what was done."""

    name: str
    title: str
    lead: str = ""
    blocks: Sequence[Block] = ()
    bad: bool = False  # whether the lead is a warning


@dataclass(frozen=True)
class KeyNumber:
    """A number for the top of the report, as text with its unit."""

    label: str
    value: str
    note: str = ""
    mark: Literal["", "good", "bad"] = ""
    key: str = ""  # of results.json, or a section of the page: where it is explained


def rendered(template: str, **content: Any) -> str:
    """Return the page of a `template` filled with `content`; text is escaped, a missing name is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("irlos_pipe.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(**content)
