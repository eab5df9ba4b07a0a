"""Makes the recordings of a case, and keeps what is true about it in another folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import Case
from benchmarks.diagnose_suite.foreign import Image, unchanged
from benchmarks.diagnose_suite.planning import plan_case
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.simulate.exposure import exposures, telescope_of
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import Planned, write_files
from irlos_pipe.simulate.recordings.making import DETECTOR_STREAM


def make_case(case: Case, data: Path, truth: Path) -> None:
    """Simulate a case.

    Parameters
    ----------
    data : Path
        Folder for its recordings, which `diagnose` reads.
    truth : Path
        Folder for ``<case>.json`` and ``<case>.yaml``, the spec.
    """
    truth.mkdir(parents=True, exist_ok=True)
    plan = plan_case(case, truth / f"{case.name}.yaml")
    zernike_nm = {}
    for planned in plan.recordings:
        zernike_nm[planned.name] = record(
            planned, data / planned.name, case.setting.highest_noll, plan.foreign.image
        )
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


def record(planned: Planned, folder: Path, highest_noll: int, hide: Image = unchanged) -> dict[int, float]:
    """Write one recording; returns the modes of its mean wavefront, Noll: nm RMS.

    They are fitted together with all modes that the wavefront has, at least up to `highest_noll`: those of
    the model, as an estimate has them.
    """
    scene, opd_nm = planned.scene, 0.0
    mean_e = np.empty((scene.frames, *scene.window))
    for index, exposure in enumerate(exposures(scene)):
        mean_e[index] = hide(exposure.mean_e)
        opd_nm = opd_nm + exposure.opd_nm / scene.frames
    _write(planned, folder, mean_e)
    fitted = telescope_of(scene).fit_zernike_nm(opd_nm, max(highest_noll, *scene.ncpa_nm))
    return dict(enumerate(fitted.tolist(), start=2))


def _write(planned: Planned, folder: Path, mean_e: np.ndarray) -> None:
    rng = np.random.default_rng([*planned.scene.seed, DETECTOR_STREAM])
    readout = Readout.of(planned.scene, mean_e.mean(axis=0))
    folder.mkdir(parents=True)
    write_files(planned, folder, readout, _frames(readout, mean_e, rng), rng)


def _frames(readout: Readout, mean_e: np.ndarray, rng: np.random.Generator) -> Iterator[Any]:
    return (readout.frames_adu(frame, rng) for frame in mean_e)
