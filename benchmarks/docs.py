"""The measured parts of ``docs/performance.md``, between markers; the text around them is kept."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.table import render

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"


def write_docs(results: dict) -> None:
    """Replace the table and the breakdown by those of `results`."""
    text = PAGE.read_text(encoding="utf-8")
    for name, content in (("table", f"```text\n{render(results)}\n```"), ("breakdown", breakdown(results))):
        block = f"<!-- {name} -->\n{content}\n<!-- end of {name} -->"
        text, found = re.subn(
            rf"<!-- {name} -->.*?<!-- end of {name} -->", lambda _, block=block: block, text, flags=re.S
        )
        if not found:
            raise SystemExit(f"{PAGE.name}: no place for the {name}: the markers <!-- {name} --> are missing")
    PAGE.write_text(text, encoding="utf-8")


def breakdown(results: dict) -> str:
    """Markdown table of shares, and the floors."""
    measured = results["breakdown"]
    dip, lift = measured["dip_global"], measured["lift"]
    groups = sorted(dip["shares"] | lift["shares"], key=lambda group: -dip["shares"].get(group, 0.0))
    rows = [
        f"| {group} | {dip['shares'].get(group, 0.0):.0%} | {lift['shares'].get(group, 0.0):.0%} |"
        for group in groups
    ]
    floor = (
        f"| floor: the single-precision products at {measured['gflops']:.0f} GFlop/s | "
        f"{dip['floor_s'] / dip['seconds']:.0%} | {lift['floor_s'] / lift['seconds']:.0%} |"
    )
    distance = f"| distance to the floor | {dip['over_floor']:.1f}× | {lift['over_floor']:.1f}× |"
    return "\n".join(["| one thread | dip_global | lift, ramp |", "|---|---|---|", *rows, floor, distance])
