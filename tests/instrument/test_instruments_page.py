"""docs/instruments.md: its example works, its reference lists every key."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from helpers.optics_cases import settings, vector
from helpers.paths import REPOSITORY
from pydantic import BaseModel

from irlos_pipe.conventions.pupil_parts import PARTS
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.instrument.profile import DEFAULTS, FACTS, ModeEntry, SeeingScaleEntry
from irlos_pipe.instrument.pupil import MapEntry, PupilSection, TurnRule, VaneEntry
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.pupil_division import petals_of, segments_of

PAGE = REPOSITORY / "docs/instruments.md"
MARKED = re.compile(r"(<!-- made by .*? -->\n).*?(\n<!-- end -->)", re.DOTALL)
PART_KEYS = {
    "diameter_m": "m",
    "corners_m": "[[x, y], …] in m, three or more",
    "flat_to_flat_m": "width of a segment between opposite sides, m",
    "gap_m": "between neighbours, m",
    "rings": "round the central segment",
    "missing": "numbers of segments that are not there",
}


def example():
    return re.search(r"```yaml\n(name:.*?)```", PAGE.read_text(), re.DOTALL)[1]


@pytest.fixture
def instrument(tmp_path):
    path = tmp_path / "example_4m.yaml"
    path.write_text(example())
    return load_instrument(path)


def test_the_example_is_the_telescope_that_the_page_describes(instrument):
    assert (petals_of(instrument.pupil).count, segments_of(instrument.pupil).count) == (3, 18)
    assert instrument.pupil.obstructions[0].placement.shift_m == pytest.approx((-1.1, 0.4))
    assert instrument.defaults["pixel_scale_mas"] == 17.6
    assert instrument.on("2021-01-01").defaults["pixel_scale_mas"] == 18.0


def test_the_example_makes_images(instrument):
    case = settings(32, diversity={}, geometry=instrument.pupil, pixel_scale_mas=17.6)
    image = PsfModel(case, (4,), dtype=torch.float64).images(vector({}, (4,)))[0].numpy()
    assert 0.5 < image.sum() < 1 and np.unravel_index(image.argmax(), image.shape)[0] in (15, 16)


def rows(model: type[BaseModel], above: str) -> Iterator[str]:
    for name, entry in model.model_fields.items():
        need = "" if entry.is_required() else " (optional)"
        yield f"| `{above}{name}` | {entry.description}{need} |"


def reference() -> str:
    facts = [
        f"| `{name}` | {rule.unit} | {rule.text}{'' if rule.required else ' (optional)'} | "
        f"{rule.low:g} to {rule.high:g} |"
        for name, rule in FACTS.items()
    ]
    parts = [
        f"| `{title}` | "
        + "; ".join(
            f"`{f.name}`: {PART_KEYS[f.name]}" for f in dataclasses.fields(part) if f.name != "placement"
        )
        + " |"
        for title, part in PARTS.items()
    ]
    sections = [
        *rows(PupilSection, "pupil."),
        *rows(VaneEntry, "pupil.vanes[]."),
        *rows(MapEntry, "pupil.map."),
        *rows(TurnRule, "pupil.turns."),
        *rows(ModeEntry, "modes.NAME."),
        *rows(SeeingScaleEntry, "seeing_scales.NAME."),
    ]
    return "\n".join(
        [
            "\n| fact | unit | what it is | limits |",
            "|---|---|---|---|",
            *facts,
            "",
            "`amplifier_e_per_adu` is needed where there are `modes`. Other facts may have any name if",
            "`defaults`, `modes` or `seeing_scales` refer to them.",
            "",
            "| key | what it is |",
            "|---|---|",
            "| `name`, `title` | name of the instrument; one line for people (optional) |",
            *sections,
            "",
            "| part | keys, in addition to `centre_m`, `rotation_deg` and `flip` (optional) |",
            "|---|---|",
            *parts,
            "",
            "`defaults` gives side-car keys that may be left out the name of the fact that stands in for",
            "each, or `{divide: [fact, fact, …]}`, the first divided by the others:",
            ", ".join(f"`{name}`" for name in DEFAULTS[:5]) + ",",
            ", ".join(f"`{name}`" for name in DEFAULTS[5:]) + ".\n",
        ]
    )


def test_the_reference_lists_every_key():
    text = PAGE.read_text()
    expected = MARKED.sub(lambda found: found[1] + reference() + found[2], text)
    if os.environ.get("REWRITE"):
        PAGE.write_text(expected)
    assert text == expected
