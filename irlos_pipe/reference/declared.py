"""What stages declare: their checks of quality control, and the arrays of their products."""

from __future__ import annotations

from collections.abc import Iterator

from irlos_pipe.product.product import Arrays, Checks
from irlos_pipe.reference.entry import Entry
from irlos_pipe.stages import LIGHT_PATH, STAGES


def check_entries() -> Iterator[Entry]:
    """Yield every check; a value out of its limits makes the exit code 4."""
    for stage in LIGHT_PATH:
        checks: Checks = getattr(STAGES[stage], "CHECKS", {})
        for name, (text, key) in checks.items():
            limit = f"{stage}.{key}" if key else "fixed"
            yield Entry("check", f"{stage}.{name}", f"{text}\nlimit: {limit}")


def array_entries() -> Iterator[Entry]:
    """Yield every array of every product."""
    for stage in LIGHT_PATH:
        arrays: Arrays = getattr(STAGES[stage], "ARRAYS", {})
        for name, (unit, axes, text) in arrays.items():
            lines = [text, *([f"unit: {unit}"] if unit else []), *([f"shape: ({axes})"] if axes else [])]
            yield Entry("array of a product", f"{stage}.{name}", "\n".join(lines))
