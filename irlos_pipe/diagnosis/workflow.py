"""The diagnosis: detect, propose, refit, decide, adapt, and judge on frames that no fit has seen."""

import time
from collections.abc import Sequence
from dataclasses import replace

import torch

from irlos_pipe.diagnosis.checks.noise import PHOTONS, judge_all
from irlos_pipe.diagnosis.conclude import conclude
from irlos_pipe.diagnosis.cube import Cube, cubes_of
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.opposite import open_facts, opposite_side
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.records import OppositeSide
from irlos_pipe.diagnosis.search import Report, Task
from irlos_pipe.diagnosis.sharing import together
from irlos_pipe.diagnosis.verdict import UNKNOWN, Diagnosis
from irlos_pipe.diagnosis.view import Exposures, Moments
from irlos_pipe.effects import Effect


@torch.no_grad()
def diagnose(
    recordings: Sequence[Exposures],
    effects: Sequence[Effect],
    options: Options,
    *,
    device: str = "cpu",
    report: Report = lambda count: None,
) -> Diagnosis:
    """Find what the model of one recording lacks, or that of several with other settings, stars or nights.

    The `recordings` have different focus, diversity or band, but the same window; those of one moment have
    one wavefront. The model has the `effects` already, stated for the first recording in which they act, see
    `view.placed`. `report` is called with the number of finished fits, for a progress bar.
    """
    began = time.perf_counter()
    cubes = cubes_of(recordings, options.held_out)
    noise = judge_all([part for cube in cubes for part in cube.training.parts])
    cube = Cube.of_all([one.limited_by(noise.kind == PHOTONS) for one in cubes])

    views = [one.view(range(2, options.highest_noll + 1), device) for one in recordings]
    fitter, moments = Fitter(views, cube.training, options.drift_nm), Moments.of(recordings)
    search = Task(cube, fitter, moments, options, report, noise.kind).searched(effects)
    diagnosis = conclude(cube, search, noise, options, recordings[0].screened)

    def opposite(label: str) -> OppositeSide | None:
        return opposite_side(fitter, search.final, label, options.sure)

    steps = [replace(one, opposite=opposite(one.label)) for one in diagnosis.steps]
    adjusted = [replace(one, opposite=opposite(one.label)) for one in diagnosis.adjusted]
    diagnosis = replace(diagnosis, steps=steps, adjusted=adjusted)
    if search.tolerant:
        known = [*(one.label for one in diagnosis.steps), *(one.label for one in diagnosis.adjusted)]
        diagnosis = replace(diagnosis, open_facts=open_facts(search.final, known))
    if moments.several and diagnosis.verdict != UNKNOWN:
        diagnosis = replace(diagnosis, together=together(search, fitter, cube, moments, options))
    return replace(diagnosis, seconds=time.perf_counter() - began)
