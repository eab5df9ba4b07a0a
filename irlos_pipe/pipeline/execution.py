"""Run the stages of a plan one after the other, each leaving its product on disk."""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import jsonable
from irlos_pipe.pipeline.inputs import InputFile, require_unchanged
from irlos_pipe.pipeline.plan import Action, Step, checksum
from irlos_pipe.pipeline.provenance import command_line, machine, now, software_versions
from irlos_pipe.pipeline.resources import Resources, limited_threads, resolve_device
from irlos_pipe.pipeline.runlog import RUN, collected, stage_logger
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.results import LOST, Provenance, Recorded, StageResults, results_of
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.product.storage import open_product, read_product, write_product
from irlos_pipe.product.table import Origin, table_content
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import StageContext, StageOutput, arrays_only, depends_on, reads
from irlos_pipe.stages.ingest.results import IngestResults


@dataclass
class Job:
    recipe: Recipe
    folder: Path
    files: list[InputFile]
    steps: list[Step]
    resources: Resources
    # Stages whose product on disk is the one the plan promises.
    finished: set[str] = field(default_factory=set)
    _loaded: dict[str, Product] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.finished |= {step.name for step in self.steps if step.current and step.action is not Action.RUN}

    def perform(self) -> None:
        for step in self.steps:
            RUN.info(step.describe())
            if step.action is Action.RUN:
                self._run(step)
                self.finished.add(step.name)

    def summaries(self) -> dict[str, Product]:
        """Return the finished products by stage name, without their arrays."""
        return {
            step.name: read_product(step.path, arrays=False)
            for step in self.steps
            if step.name in self.finished
        }

    def _run(self, step: Step) -> None:
        log = stage_logger(step.name)
        started, clock = now(), time.perf_counter()
        context = self._context(step, log)
        stage = STAGES[step.name]
        with collected(log) as lines, limited_threads(self.resources.jobs, arrays_only=arrays_only(stage)):
            output = stage.run(context)
        if "inputs" in depends_on(stage):
            require_unchanged(self.files)
        seconds = round(time.perf_counter() - clock, 3)
        self._write(step, output, {"started": started, "finished": now(), "seconds": seconds}, lines)
        for line in output.failures:
            RUN.warning("%s: lost: %s", step.name, line)
        RUN.info("%s: done in %.1f s", step.name, seconds)

    def _context(self, step: Step, log: logging.Logger) -> StageContext:
        name = step.name
        return StageContext(
            self.recipe.configs[name],
            self.recipe.model,
            self.recipe.instrument,
            self.recipe.inputs,
            self._read_by(name),
            self._device(name),
            self.recipe.seed,
            self.resources.jobs,
            self.resources.progress,
            log,
            RunFolder(self.folder).scratch(name, step.key),
        )

    def _device(self, name: str) -> str:
        wanted = self.resources.device
        return "cpu" if wanted == "auto" and arrays_only(STAGES[name]) else resolve_device(wanted)

    def _read_by(self, name: str) -> dict[str, Product]:
        """Products of the earlier stages that a stage reads, each opened once."""
        wanted = reads(STAGES[name], self.recipe.stages[: self.recipe.stages.index(name)])
        for step in self.steps:
            if step.name in wanted and step.name not in self._loaded:
                self._loaded[step.name] = open_product(step.path)
        return {other: self._loaded[other] for other in wanted}

    def _write(self, step: Step, output: StageOutput, times: dict[str, Any], log: list[str]) -> None:
        """Write the further files first: the product says that the stage is complete."""
        config = jsonable(self.recipe.configs[step.name])
        before = self._read_by(step.name)
        seen = recordings_of(output.results, before, config)
        notice = self.recipe.notice if self.recipe.samples else ""
        provenance = {
            "key": step.key,
            "parts": step.parts,
            "recipe": self.recipe.name,
            "summary": [*output.summary, *(f"{LOST:16s}{line}" for line in output.failures)],
            "failures": list(output.failures),
            "inputs": self.files,
            "seed": self.recipe.seed,
            "device": self._device(step.name),
            "jobs": self.resources.jobs,
            "software": software_versions(),
            "machine": machine(),
            "command": command_line(),
            **times,
            "recordings": [one.as_json() for one in seen],
            "notice": notice,
        }
        checks = [check for product in before.values() for check in _checks_of(seen, product)]
        origin = Origin(
            step.name,
            f"IRLOS_{step.name.upper()}",
            Provenance.model_validate(jsonable(provenance)),
            seen,
            [*checks, *output.checks],
            config,
            notice,
        )
        files = {
            PurePath(name).name: file
            if isinstance(file, bytes)
            else table_content(file, PurePath(name).suffix, origin)
            for name, file in output.files.items()
        }
        for name, content in files.items():
            write_bytes(self.folder / name, content)
        checksums = {name: checksum(content) for name, content in files.items()}
        provenance |= {"files": sorted(files), "file_sha256": checksums}
        product = Product(
            step.name, output.arrays, output.results.as_json(), list(output.checks), config, provenance, log
        )
        write_product(product, step.path)
        RunFolder(self.folder).remove_scratch(step.name)


def recordings_of(
    results: StageResults, before: Mapping[str, Product], config: Mapping[str, Any]
) -> list[Recorded]:
    """Return the recordings that a stage works on: those of its recipe input, else all that are no darks.

    They stand in the `results` of ingest, or in the product of it among those read `before`.
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


def _checks_of(recordings: Sequence[Recorded], product: Product) -> Iterator[Check]:
    """The checks of a product, of `ingest` those of the recordings."""
    prefixes = tuple(f"ingest/{one.input}/{one.name}/" for one in recordings)
    for check in product.checks:
        if product.stage != IngestResults.stage or check.name.startswith(prefixes):
            yield check
