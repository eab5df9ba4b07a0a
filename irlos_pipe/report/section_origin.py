"""Section on where the products come from, and the recipe."""

from __future__ import annotations

from irlos_pipe.product.product import Product
from irlos_pipe.product.results import Provenance, provenance_of
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
    return _moment(_latest(run).finished)


def warnings(run: RunData) -> list[str]:
    """Return what the stages warned of, each once, and the exposures that failed."""
    found = []
    for stage, product in run.products.items():
        found += [
            f"{stage}: {line.partition(' ')[2]}"
            for line in product.log
            if line.startswith(("WARNING ", "ERROR ", "CRITICAL "))
        ]
        found += [f"{stage}: lost: {failure}" for failure in provenance_of(product).failures]
    return list(dict.fromkeys(found))


def _latest(run: RunData) -> Provenance:
    """Provenance of the product made last."""
    made = (provenance_of(product) for product in run.products.values())
    return max(made, key=lambda one: one.finished, default=Provenance())


def _moment(iso_time: str) -> str:
    return f"{iso_time[:16].replace('T', ' ')} UTC" if iso_time else ""


def _lead(made: Provenance) -> str:
    seed = "" if made.seed is None else made.seed
    facts = [made.command, f"seed {seed}", f"{made.machine.host} ({made.machine.platform})"]
    facts += [f"{name} {version}" for name, version in made.software.items()]
    return " · ".join(facts)


def _stages(run: RunData) -> Table:
    return Table(
        ("stage", "finished", "time [s]", "device", "threads", "irlos_pipe"),
        [_stage_row(stage, product) for stage, product in run.products.items()],
        "Stages",
    )


def _stage_row(stage: str, product: Product) -> tuple[str, ...]:
    made = provenance_of(product)
    return (
        stage,
        _moment(made.finished),
        number(made.seconds),
        made.device,
        "" if made.jobs is None else str(made.jobs),
        made.software.get("irlos_pipe", ""),
    )


def _inputs(made: Provenance) -> list[Table]:
    rows = [(one.label, one.sha256[:CHECKSUM_DIGITS]) for one in made.inputs]
    return [Table(("file", "sha256"), rows, f"Input files ({len(rows)})", folded=True)] if rows else []
