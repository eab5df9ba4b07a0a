"""Pieces of messages for people: suggestions, counts of what is left out, tables of text."""

import math
from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def nearest(word: object, known: Iterable[str]) -> str | None:
    """Return the entry of `known` that is spelt most like `word`, or None if none is close."""
    return next(iter(get_close_matches(str(word), list(known), n=1, cutoff=0.5)), None)


def suggestion(word: object, known: Iterable[object]) -> str:
    """Return ``; did you mean 'x'?`` for a `word` like one that is `known`, else list what is known."""
    names = [str(name) for name in known]
    close = nearest(word, names)
    if close is not None:
        return f"; did you mean '{close}'?"
    return f"; known: {', '.join(names)}" if names else ""


def rounded_by_error(value: float, error: float, pattern: str = "") -> str:
    """Return ``value ± error`` to the second digit of the `error`, or the `value` where that is not positive.

    The `pattern` is the format of the value alone. Of the two together it says whether the value has a sign
    (``+``) and whether both are in per cent (``%``).
    """
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return format(value, pattern)
    factor, unit = (100.0, " %") if pattern.endswith("%") else (1.0, "")
    decimals = 1 - math.floor(math.log10(factor * error))
    value, error = (round(factor * one, decimals) for one in (value, error))
    sign, digits = "+" if pattern.startswith("+") else "", max(decimals, 0)
    return f"{value:{sign}.{digits}f} ± {error:.{digits}f}{unit}"


def and_more(items: Sequence[object]) -> str:
    """Return what follows the first of several items when the others are not shown."""
    return f" (and {len(items) - 1} more)" if len(items) > 1 else ""


def printable(text: str) -> str:
    """Return one line of `text` with an escape for whatever would not show, or would steer a terminal.

    Control characters, line ends and bytes of names that are no UTF-8 are among these.
    """
    escaped = (one.encode("unicode_escape", "backslashreplace").decode("ascii") for one in text)
    return "".join(one if one.isprintable() else other for one, other in zip(text, escaped, strict=True))


def aligned(rows: Sequence[Sequence[str]], *, numbers: bool = False) -> str:
    """Return `rows` of text, of as many cells each, as a table with columns of equal width.

    All are aligned to the left, and a first cell that repeats the one above is left blank; with `numbers`,
    all columns but the first are aligned to the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines, previous = [], None
    for first, *rest in rows:
        cells = ["" if first == previous and not numbers else first, *rest]
        padded = [
            cell.rjust(width) if numbers and column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        lines.append("  ".join(padded).rstrip())
        previous = first
    return "\n".join(lines)
