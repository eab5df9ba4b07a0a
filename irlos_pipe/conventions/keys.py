"""What a dataclass says about its values where files give them: the meaning of a key, and its limits.

The standard library alone, so that science can say it; pydantic reads it where the files are checked.
"""

import math
from collections.abc import Callable
from dataclasses import MISSING, field
from typing import Annotated, Any, TypeVar

Row = TypeVar("Row", bound=type)
DITTO = "〃"  # the meaning of the field above says what this one is as well


def key(default: Any = MISSING, meaning: str = "", **how: Any) -> Any:
    """Return the field of a dataclass that a file gives, of a `meaning` for messages and references.

    Where the file is silent it has the `default`; without one it must be given. `how` is of pydantic's
    ``Field``: limits such as ``ge``; ``alias``, the key where it is not the field's name.
    """
    metadata = {"description": meaning, **how}
    if isinstance(default, (dict, list)):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


class Limited:
    """The same for a value within a tuple: ``Annotated[int, Limited("row", ge=0)]``."""

    def __init__(self, meaning: str = "", **limits: float):
        self.meaning, self.limits = meaning, limits

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], dict]) -> dict:
        return handler(source) | self.limits


def named_row(row: Row) -> Row:
    """Let a named tuple be written as a mapping, as files give it."""
    how = {"type": "function-plain", "function": row._asdict}  # type: ignore[attr-defined]
    row.__get_pydantic_core_schema__ = classmethod(  # type: ignore[attr-defined]
        lambda cls, source, handler: handler(source) | {"serialization": how}
    )
    return row


class NullIsNan:
    """Says to pydantic, which science does not know, that null stands for NaN."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> dict[str, Any]:
        """Return how such a number is read."""
        function = {"type": "no-info", "function": lambda value: math.nan if value is None else value}
        return {"type": "function-before", "function": function, "schema": handler(source)}


Number = Annotated[float, NullIsNan()]
