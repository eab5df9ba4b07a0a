"""From a case to its recordings, with what is true about it in another folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import (
    IN_SKY_MODEL,
    MIXED_UP,
    OFFSETS_NM,
    RAMP_FRAMES,
    SKY_PUPIL_SAMPLES,
    Case,
    size_of,
)
from benchmarks.diagnose_suite.foreign import FOREIGN, Foreign, Image
from benchmarks.diagnose_suite.hidden import Hidden, Mild, drawn, drawn_mild
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.exposure import exposures, telescope_of
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import Planned, write_files
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings

CUBE, RAMP, CALIBRATION = "cube", "ramp", "calibration"
SECTIONS, HIDDEN, OUTSIDE, ORDER, MILD = range(5)  # streams of random numbers of a case
DETECTOR_STREAM = 1  # child of a scene's seed; the wavefront has its own


@dataclass(frozen=True)
class Plan:
    """Recordings of a case, and what is hidden in them: effects, one that is foreign, mild errors."""

    recordings: Sequence[Planned]
    hidden: Sequence[Hidden]
    foreign: Foreign
    mild: Mild


def plan_case(case: Case, spec_path: Path) -> Plan:
    """Plan a case; its spec, which states the truth, is written to `spec_path`."""
    hidden = hidden_in(case)
    spec_path.write_text(yaml_text(spec_of(case, hidden)))
    recordings = plan_recordings(load_spec(spec_path))
    makers = [FOREIGN[effect] for effect in case.effects if effect in FOREIGN]
    foreign = makers[0](_rng(case, OUTSIDE)) if makers else Foreign()
    if case.effects == (MIXED_UP,):
        recordings = _mixed_up(recordings, _rng(case, ORDER))
    with_patches = [_with_patches(one, foreign) for one in recordings]
    return Plan(with_patches, hidden, foreign, mild_in(case, hidden))


def spec_of(case: Case, hidden: Sequence[Hidden]) -> dict[str, Any]:
    """The case as a spec of `irlos simulate`."""
    mild = mild_in(case, hidden)
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


def hidden_in(case: Case) -> list[Hidden]:
    """Return the effects of the catalogue that a case hides."""
    if not case.level:
        return []
    rng = _rng(case, HIDDEN)
    sizes = [size_of(effect, case.setting.name, case.level) for effect in case.effects]
    return [drawn(*one, case.setting, rng) for one in zip(case.effects, sizes, strict=True)]


def mild_in(case: Case, hidden: Sequence[Hidden]) -> Mild:
    """Return the mild errors besides what is `hidden`."""
    if not case.dirty:
        return Mild()
    parameters = {one.effect: one.parameters for one in hidden}
    return drawn_mild(case.setting, _rng(case, MILD)).without(parameters, case.setting)


def _rng(case: Case, stream: int) -> np.random.Generator:
    return np.random.default_rng([case.seed, stream])


def _with_sky_of(sections: dict[str, Any], hidden: Hidden) -> dict[str, Any]:
    """The AO residual or the image motion itself is what is hidden."""
    if hidden.effect == "tip_tilt_jitter":
        return sections | {"motion": {"rms_mas": hidden.truth["sigma_mas"]}}
    wfe_nm, law = hidden.truth["wfe_nm"], load_instrument("irlos").facility.residual_law
    seeing_arcsec = (wfe_nm - law.floor_nm) / law.nm_per_arcsec
    return sections | {"sky": {**sections["sky"], "seeing_arcsec": seeing_arcsec, "wfe_nm": wfe_nm}}


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
    scene = planned.scene
    pupil = replace(scene.geometry, vanes=(*scene.geometry.vanes, *foreign.patches))
    return replace(planned, scene=replace(scene, facility=replace(scene.facility, pupil=pupil)))


# -- the files ---------------------------------------------------------------------------------


def make_case(case: Case, data: Path, truth: Path) -> dict[str, Any]:
    """Simulate a case into the folder `data`, which `diagnose` reads; returns what is true.

    The folder `truth` gets that as ``<case>.json``, and the spec as ``<case>.yaml``.
    """
    truth.mkdir(parents=True, exist_ok=True)
    plan = plan_case(case, truth / f"{case.name}.yaml")
    highest_noll, image = case.setting.highest_noll, plan.foreign.image
    zernike_nm = {
        planned.name: record(planned, data / planned.name, highest_noll, image) for planned in plan.recordings
    }
    content = {
        "kind": case.kind,
        "suite_seed": case.suite_seed,
        "dirty": case.dirty,
        "mild": plan.mild.truth,
        "setting": case.setting.name,
        "level": case.level,
        "effects": list(case.effects),
        "sizes": {one.effect: one.truth for one in plan.hidden},
        "known": {one.effect: one.known for one in plan.hidden},
        "outside": plan.foreign.truth,
        "mean_zernike_nm": zernike_nm,
    }
    write_bytes(truth / f"{case.name}.json", json_text(content).encode())
    return content


def record(planned: Planned, folder: Path, highest_noll: int, hide: Image = np.asarray) -> dict[int, float]:
    """Write one recording; returns the modes of its mean wavefront, Noll: nm RMS.

    They are fitted together with all modes that the wavefront has, at least up to `highest_noll`: those of
    the model, as an estimate has them.
    """
    scene, opd_nm = planned.scene, 0.0
    mean_e = np.empty((scene.frames, *scene.window))
    for index, exposure in enumerate(exposures(scene)):
        mean_e[index] = hide(exposure.mean_e)
        opd_nm = opd_nm + exposure.opd_nm / scene.frames
    rng = np.random.default_rng([*scene.seed, DETECTOR_STREAM])
    readout = Readout.of(scene, mean_e.mean(axis=0))
    folder.mkdir(parents=True)
    write_files(planned, folder, readout, (readout.frames_adu(frame, rng) for frame in mean_e), rng)
    fitted = telescope_of(scene).fit_zernike_nm(opd_nm, max(highest_noll, *scene.ncpa_nm))
    return dict(enumerate(fitted.tolist(), start=2))
