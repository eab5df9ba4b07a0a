"""The tables of the suite, and their place in docs/focus.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.focus_faults.judging import Hour, Verdict
from benchmarks.pages import put

PAGE = Path(__file__).parents[2] / "docs" / "focus.md"


def table(verdicts: Sequence[Verdict], *, used_only: bool = False) -> str:
    """Return the table of families in Markdown, or of those of which anything was used or is not as asked."""
    groups: dict[tuple[bool, str, str], list[Verdict]] = {}
    for one in verdicts:
        family = "damaged in one place" if one.kind == "files" else one.family
        groups.setdefault((not one.known, one.kind, family), []).append(one)
    lines = [
        "| kind | family | cases | bad | used, right | used, wrong | right ones refused | else |",
        "|---|---|---:|---:|---:|---:|---:|---|",
    ]
    for (_, kind, family), found in sorted(groups.items(), key=lambda item: item[0]):
        if used_only and not any(one.commanded_right or one.failed for one in found):
            continue
        counts = [
            sum(getattr(one, name) for one in found)
            for name in ("bad", "commanded_right", "commanded_wrongly", "refused")
        ]
        problems = "; ".join(sorted({one.problem for one in found if one.problem}))
        lines.append(
            f"| {kind} | {family} | {len(found)} | " + " | ".join(map(str, counts)) + f" | {problems} |"
        )
    return "\n".join(lines)


def summary(verdicts: Sequence[Verdict]) -> str:
    """Return the totals in one line each."""
    lines = []
    for words, known in (("asked for", True), ("further", False)):
        found = [one for one in verdicts if one.known == known]
        lines.append(
            f"{len(found)} cases of kinds {words}: {sum(one.bad for one in found)} bad exposures, of which "
            f"{sum(one.commanded_wrongly for one in found)} commanded wrongly and "
            f"{sum(one.commanded_right for one in found)} with a right value; "
            f"{sum(one.refused for one in found)} of {sum(one.right for one in found)} right ones refused; "
            f"{sum(bool(one.problem) for one in found)} cases not as asked otherwise."
        )
    return "\n".join(lines)


def hours_table(found: Sequence[Hour]) -> str:
    """Return the table of hours of right exposures in Markdown."""
    lines = [
        '| seeing ["] | m_J | exposures | refused | beyond 3 σ, 5 nm | residual [nm RMS] | median σ [nm] |',
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for one in found:
        refused = f"{one.refused}{' (' + ', '.join(one.reasons) + ')' if one.reasons else ''}"
        row = one.seeing, f"{one.mag_j:g}", one.exposures, refused, one.wrong
        lines.append(f"| {' | '.join(map(str, row))} | {one.residual_nm:.1f} | {one.sigma_nm:.1f} |")
    return "\n".join(lines)


def write_page(text: str) -> None:
    """Put `text` between the marks of docs/focus.md."""
    put(PAGE, {"focus_faults": text})
