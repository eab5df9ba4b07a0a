"""What `irlos simulate` reports: the plan, and where everything is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from irlos_pipe.simulate.recordings.planned import Planned
from irlos_pipe.simulate.recordings.run import UP_TO_DATE, Step
from irlos_pipe.simulate.recordings.spec import Spec


def plan_rows(steps: Sequence[Step]) -> list[tuple[str, ...]]:
    """Return one row of text per recording: name, what is recorded, photons, size, what would be done."""
    return [(step.planned.name, *_described(step.planned), *_action(step)) for step in steps]


def _action(step: Step) -> tuple[str, str]:
    return ("simulate", step.reason) if step.reason else ("skip", UP_TO_DATE)


def _described(planned: Planned) -> tuple[str, ...]:
    scene = planned.scene
    return (
        f"{scene.frames} x {scene.exposure_s:g} s",
        f"m_J {scene.mag_j:g}",
        f"{scene.photons:.2g} photons/frame",
        f"{planned.size_bytes / 1e6:.2g} MB",
    )


def where_text(spec: Spec, folder: Path) -> str:
    """Return where in `folder` data and truth lie, one line per section of the `spec`."""
    width = max(len("truth"), *map(len, spec.recordings))
    places = {name: folder / "data" / name for name in spec.recordings} | {"truth": folder / "truth"}
    return "\n".join(f"{name:<{width}}  {path}" for name, path in places.items())
