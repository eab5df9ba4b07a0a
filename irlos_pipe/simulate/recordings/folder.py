"""The folder of a simulation: where data and truth lie, and what of it is still good."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import changed_values
from irlos_pipe.simulate.recordings.files import layout_of
from irlos_pipe.simulate.recordings.planned import DOUBLE, Planned
from irlos_pipe.simulate.recordings.truth import made_from

MAX_REASONS = 3
KINDS = ("recording", "scene")  # sections whose name means nothing to a reader
WORK_PREFIX = ".simulating-"


@dataclass(frozen=True)
class SimulationFolder:
    """Names of the files in the folder of a simulation."""

    path: Path

    @property
    def spec(self) -> Path:
        """The spec with every default made explicit; it contains the truth, so it lies outside the data."""
        return self.path / "simulation.resolved.yaml"

    def data(self, planned: Planned) -> Path:
        """Folder of a recording; it holds nothing else."""
        return self.path / "data" / planned.name

    def truth(self, planned: Planned) -> Path:
        """Path of the truth files of a recording, without suffix."""
        stem = layout_of(planned).file_stem()
        own = planned.name if planned.name.rpartition("/")[2] == stem else f"{planned.name}/{stem}"
        return self.path / "truth" / own.replace("/", DOUBLE)

    def reason(self, planned: Planned) -> str:
        """Why a recording has to be made; empty when it is there, of the same spec and seed."""
        before = _read_made_from(self.truth(planned))
        if before is None or not self.data(planned).is_dir():
            return "not there yet"
        return changes(before, made_from(planned))

    def require_own(self, planned: Sequence[Planned]) -> None:
        """Refuse to replace data that this command did not make.

        Raises
        ------
        ConfigurationError
        """
        for one in planned:
            if self.data(one).exists() and not self.spec.is_file():
                raise ConfigurationError(
                    f"{self.data(one)}: is there, but was not made by irlos simulate; choose another --output"
                )

    def outdated(self, planned: Sequence[Planned]) -> Iterator[str]:
        """Truth files, without ending, of recordings that a series of the spec no longer has."""
        wanted = {self.truth(one).name for one in planned}
        sections = {one.name.partition("/")[0] for one in planned}
        for path in sorted((self.path / "truth").glob("*.json")):
            name = path.name.removesuffix(".json")
            if name not in wanted and name.partition(DOUBLE)[0] in sections:
                yield name

    def remove(self, truth_name: str) -> str:
        """Remove the truth and the data of a recording; returns its name."""
        truth = self.path / "truth" / truth_name
        before = _read_made_from(truth)
        name = before["recording"]["name"] if before else truth_name.replace(DOUBLE, "/")
        self.forget(truth)
        data = (self.path / "data").resolve()
        if data in (data / name).resolve().parents:  # whoever changed the truth may have named any folder
            shutil.rmtree(data / name, ignore_errors=True)
        return name

    def forget(self, truth: Path) -> None:
        """Remove the files of a truth."""
        for suffix in (".json", "_wavefront.fits"):
            truth.with_name(truth.name + suffix).unlink(missing_ok=True)

    def remove_leftovers(self) -> None:
        """Remove what a killed run left half done (only safe for the owner of the folder)."""
        for work in self.path.glob(f"{WORK_PREFIX}*"):
            shutil.rmtree(work, ignore_errors=True)


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Name the first few values in which `old` and `new` differ; empty when none does."""
    names = [".".join(part for part in name if part not in KINDS) for name in changed_values(old, new)]
    more = f" and {len(names) - MAX_REASONS} more" if len(names) > MAX_REASONS else ""
    return f"changed: {', '.join(names[:MAX_REASONS])}{more}" if names else ""


def _read_made_from(truth: Path) -> dict[str, Any] | None:
    """What a recording was made from; None when it is not there or cannot be read."""
    try:
        return json.loads(truth.with_name(f"{truth.name}.json").read_text())["simulation"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
