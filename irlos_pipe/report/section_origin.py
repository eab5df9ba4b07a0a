"""Section on where the products come from, and the recipe."""

from __future__ import annotations

from typing import Any

from irlos_pipe.product.product import Product
from irlos_pipe.report.content import Block, Section, Table, Text
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number

CHECKSUM_DIGITS = 12


def origin_section(run: RunData) -> Section:
    """Build the section."""
    last = _latest(run)
    blocks: list[Block] = [
        _stages(run),
        *_inputs(last),
        Text(run.recipe_text, "Resolved recipe", verbatim=True, folded=True),
    ]
    return Section("origin", "Provenance", _lead(last), blocks)


def finished(run: RunData) -> str:
    """Return when the last stage ended, to the minute; empty without products."""
    return _moment(_latest(run).get("finished"))


def warnings(run: RunData) -> list[str]:
    """Return what the stages warned of, and the exposures that failed."""
    found = []
    for stage, product in run.products.items():
        found += [
            f"{stage}: {line.partition(' ')[2]}"
            for line in product.log
            if line.startswith(("WARNING ", "ERROR ", "CRITICAL "))
        ]
        found += [f"{stage}: lost: {failure}" for failure in product.provenance.get("failures", [])]
    return found


def _latest(run: RunData) -> dict[str, Any]:
    """Provenance of the product made last."""
    return max(
        (product.provenance for product in run.products.values()),
        key=lambda provenance: provenance.get("finished") or "",
        default={},
    )


def _moment(iso_time: str | None) -> str:
    return f"{iso_time[:16].replace('T', ' ')} UTC" if iso_time else ""


def _lead(provenance: dict[str, Any]) -> str:
    machine = provenance.get("machine", {})
    facts = [
        provenance.get("command", ""),
        f"seed {provenance.get('seed', '')}",
        f"{machine.get('host', '')} ({machine.get('platform', '')})",
    ]
    facts += [f"{name} {version}" for name, version in provenance.get("software", {}).items()]
    return " · ".join(facts)


def _stages(run: RunData) -> Table:
    return Table(
        ("stage", "finished", "time [s]", "device", "threads", "irlos_pipe"),
        [_stage_row(stage, product) for stage, product in run.products.items()],
        "Stages",
    )


def _stage_row(stage: str, product: Product) -> tuple[str, ...]:
    made = product.provenance
    return (
        stage,
        _moment(made.get("finished")),
        number(made.get("seconds")),
        made.get("device", ""),
        str(made.get("jobs", "")),
        made.get("software", {}).get("irlos_pipe", ""),
    )


def _inputs(provenance: dict[str, Any]) -> list[Table]:
    rows = [(one["label"], one["sha256"][:CHECKSUM_DIGITS]) for one in provenance.get("inputs", [])]
    return [Table(("file", "sha256"), rows, f"Input files ({len(rows)})", folded=True)] if rows else []
