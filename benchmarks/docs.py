"""The measured parts of ``docs/performance.md``, between markers; the text around them is kept."""

from __future__ import annotations

from pathlib import Path

from benchmarks.pages import put
from benchmarks.table import render

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"


def write_docs(results: dict) -> None:
    """Replace the table and the breakdown by those of `results`."""
    put(PAGE, {"table": f"```text\n{render(results)}\n```", "breakdown": breakdown(results)})


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
