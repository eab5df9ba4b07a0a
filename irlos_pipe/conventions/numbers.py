"""Numbers of what is written as JSON, which has no NaN."""

from __future__ import annotations

import math
from typing import Annotated, Any


class NullIsNan:
    """Says to pydantic, which science does not know, that null stands for NaN."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> dict[str, Any]:
        """Return how such a number is read."""
        function = {"type": "no-info", "function": lambda value: math.nan if value is None else value}
        return {"type": "function-before", "function": function, "schema": handler(source)}


Number = Annotated[float, NullIsNan()]
