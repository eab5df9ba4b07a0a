"""From a case to the recordings that have to be made for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import IN_SKY_MODEL, MIXED_UP, Case
from benchmarks.diagnose_suite.foreign import FOREIGN, Foreign
from benchmarks.diagnose_suite.hidden import Hidden, drawn
from benchmarks.diagnose_suite.levels import size_of
from benchmarks.diagnose_suite.mild import Mild, drawn_mild
from benchmarks.diagnose_suite.settings import OFFSETS_NM, RAMP_FRAMES, SKY_PUPIL_SAMPLES
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.recordings.files import Planned
from irlos_pipe.simulate.recordings.series import plan_recordings
from irlos_pipe.simulate.recordings.spec import load_spec
from irlos_pipe.simulate.scene import Scene

CUBE, RAMP, CALIBRATION = "cube", "ramp", "calibration"
SECTIONS, HIDDEN, OUTSIDE, ORDER, MILD = range(5)  # streams of random numbers of a case


@dataclass(frozen=True)
class Plan:
    """What is made for a case.

    Attributes
    ----------
    recordings : sequence of Planned
    hidden : sequence of Hidden
        Effects of the catalogue.
    foreign : Foreign
        The effect that it does not have, or none.
    mild : Mild
        What else is a little wrong.
    """

    recordings: Sequence[Planned]
    hidden: Sequence[Hidden]
    foreign: Foreign
    mild: Mild


def plan_case(case: Case, spec_path: Path) -> Plan:
    """Plan a case; its spec, which states the truth, is written to `spec_path`."""
    hidden = _hidden(case)
    mild = _mild(case, hidden)
    spec_path.write_text(yaml_text(spec_of(case, hidden)))
    recordings = plan_recordings(load_spec(spec_path))
    foreign = _foreign(case)
    if case.effects == (MIXED_UP,):
        recordings = _mixed_up(recordings, _rng(case, ORDER))
    return Plan([_with_patches(one, foreign) for one in recordings], hidden, foreign, mild)


def spec_of(case: Case, hidden: Sequence[Hidden]) -> dict[str, Any]:
    """The case as a spec of `irlos simulate`."""
    mild = _mild(case, hidden)
    sections = mild.over(case.setting.sections(_rng(case, SECTIONS)))
    of_sky = [one for one in hidden if case.setting.on_sky and one.effect in IN_SKY_MODEL]
    for one in of_sky:
        sections = _with_sky_of(sections, one)
    effects = {
        one.effect: {**mild.effects.get(one.effect, {}), **one.parameters}
        for one in hidden
        if one not in of_sky
    }
    if "seeing_halo" in effects:
        sections = sections | {"sampling": {**sections["sampling"], "pupil_samples": SKY_PUPIL_SAMPLES}}
    head = {"simulation": "hidden_effect", "seed": case.seed}
    return head | sections | {"recordings": _recordings(case, effects)}


def _rng(case: Case, stream: int) -> np.random.Generator:
    return np.random.default_rng([case.seed, stream])


def _hidden(case: Case) -> list[Hidden]:
    if not case.level:
        return []
    rng = _rng(case, HIDDEN)
    sizes = [size_of(effect, case.setting.name, case.level) for effect in case.effects]
    return [drawn(*one, case.setting, rng) for one in zip(case.effects, sizes, strict=True)]


def _mild(case: Case, hidden: Sequence[Hidden]) -> Mild:
    if not case.dirty:
        return Mild()
    parameters = {one.effect: one.parameters for one in hidden}
    return drawn_mild(case.setting, _rng(case, MILD)).without(parameters, case.setting)


def _foreign(case: Case) -> Foreign:
    makers = [FOREIGN[effect] for effect in case.effects if effect in FOREIGN]
    return makers[0](_rng(case, OUTSIDE)) if makers else Foreign()


def _with_sky_of(sections: dict[str, Any], hidden: Hidden) -> dict[str, Any]:
    """The AO residual or the image motion itself is what is hidden."""
    if hidden.effect == "tip_tilt_jitter":
        return sections | {"motion": {"rms_mas": hidden.truth["sigma_mas"]}}
    wfe_nm, law = hidden.truth["wfe_nm"], load_instrument("irlos").facility.residual_law
    seeing_arcsec = (wfe_nm - law.floor_nm) / law.nm_per_arcsec
    sky = {**sections["sky"], "seeing_arcsec": seeing_arcsec, "wfe_nm": wfe_nm}
    return sections | {"sky": sky}


def _recordings(case: Case, effects: dict[str, Any]) -> dict[str, Any]:
    star = case.setting.recording()
    if not case.is_ramp:
        return {CUBE: star | {"effects": effects}}
    ramp = {"role": "defocus_ramp", "frames": RAMP_FRAMES, "offsets_nm": list(OFFSETS_NM), "effects": effects}
    return {CALIBRATION: star, RAMP: star | ramp}


def _mixed_up(recordings: Sequence[Planned], rng: np.random.Generator) -> list[Planned]:
    """The ramp's folders hold each other's offsets."""
    ramp = [index for index, one in enumerate(recordings) if one.name.startswith(RAMP)]
    mixed = list(recordings)
    for index, other in zip(ramp, rng.permutation(ramp), strict=True):
        scene = replace(recordings[index].scene, introduced_nm=recordings[other].scene.introduced_nm)
        mixed[index] = replace(recordings[index], scene=scene)
    return mixed


def _with_patches(planned: Planned, foreign: Foreign) -> Planned:
    scene: Scene = planned.scene
    pupil = replace(scene.geometry, vanes=(*scene.geometry.vanes, *foreign.patches))
    return replace(planned, scene=replace(scene, facility=replace(scene.facility, pupil=pupil)))
