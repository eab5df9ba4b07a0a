"""What the product of a stage was made from, for the headers of what is handed on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from irlos_pipe.files.json import jsonable
from irlos_pipe.product.header import Origin
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.results import Provenance, Recorded, StageResults, results_of
from irlos_pipe.stages.ingest.results import IngestResults


def recordings_of(
    results: StageResults, before: Mapping[str, Product], config: Mapping[str, Any]
) -> list[Recorded]:
    """Return the recordings that a stage works on: those of its recipe input, else all that are no darks.

    Parameters
    ----------
    results : StageResults
        Of the stage.
    before : mapping of str to Product
        The products it read.
    config : mapping
        Its settings, of which ``input`` names the recipe input.
    """
    if isinstance(results, IngestResults):
        rows = results.inputs
    elif IngestResults.stage in before:
        rows = results_of(IngestResults, before[IngestResults.stage]).inputs
    else:
        return []
    wanted = config.get("input")
    return [
        Recorded(
            name=row.name, input=row.input, role=row.role, window=row.window, frames=row.frames,
            frames_rejected=row.frames_rejected, **dict(row.observed),
        )
        for row in rows
        if row.role != "dark" and wanted in (None, row.input)
    ]  # fmt: skip


def origin_of(
    stage: str,
    provenance: Mapping[str, Any],
    recordings: Sequence[Recorded],
    before: Mapping[str, Product],
    checks: Sequence[Check],
    config: Mapping[str, Any],
    notice: str = "",
) -> Origin:
    """Return where the numbers of a `stage` come from.

    Parameters
    ----------
    stage : str
        Its name.
    provenance : mapping
        Of its product.
    recordings : sequence of Recorded
        What it works on.
    before : mapping of str to Product
        The products it read; their checks count too.
    checks : sequence of Check
        Its own.
    config : mapping
        Its settings.
    notice : str
        Of the recipe, as of samples.
    """
    earlier = [check for product in before.values() for check in _of(recordings, product)]
    return Origin(
        stage,
        f"IRLOS_{stage.upper()}",
        Provenance.model_validate(jsonable(provenance)),
        recordings,
        [*earlier, *checks],
        config,
        notice,
    )


def _of(recordings: Sequence[Recorded], product: Product) -> Iterator[Check]:
    """The checks of a product, of `ingest` those of the recordings."""
    prefixes = tuple(f"ingest/{one.input}/{one.name}/" for one in recordings)
    for check in product.checks:
        if product.stage != IngestResults.stage or check.name.startswith(prefixes):
            yield check
