"""The diagnosis: detect, propose, refit, decide, adapt, and judge on frames that no fit has seen.

A stop that is moved one way and one that is moved the other way make the same image to first order, but for
the even part of the wavefront. Odd modes imitate the difference: behind a strong AO residual both sides may
fit.

None of the facts that stay free is named. A name needs evidence; an estimate needs none. A calibration that
takes for exact what was only declared errs by all that this is wrong, up to the five standard errors from
which an effect is named. To free it costs the variance that it adds to all else, and pays where it is off by
more than some √2 standard errors (Akaike 1974, IEEE Trans. Autom. Control 19, 716). Where a diagnosis had to
free all facts at once, those stay free in the model that it leaves, from where they fit best: a displaced
stop is begun on every side of the pupil, as the image has a kink where it is not displaced. Facts of a
design, such as square pixels, are left as they are: what the model of the AO residual misses imitates them.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.diagnosis.checks import PHOTONS, judge_all
from irlos_pipe.diagnosis.conclude import conclude
from irlos_pipe.diagnosis.cube import Cube, cubes_of
from irlos_pipe.diagnosis.fitting import POINTING, Fitter, begun_at
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import OppositeSide, Options
from irlos_pipe.diagnosis.search import Report, Task
from irlos_pipe.diagnosis.sharing import together
from irlos_pipe.diagnosis.verdict import UNKNOWN, Diagnosis
from irlos_pipe.diagnosis.view import Exposures, Moments
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.base import AT_REST, direction_among

WORTH = 1.5  # standard errors by which a fact must be off to be worth its freedom, some √2


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


def opposite_side(fitter: Fitter, final: Optimum, label: str, sure: float) -> OppositeSide | None:
    """The `final` fit with an effect of the pupil on its opposite side, unless the data exclude that.

    The data exclude it from a significance of `sure` on, in Gaussian σ. None as well for effects without a
    direction in the pupil or at no distance, and where the fit leads back.
    """
    fitted = final.fitted
    if label not in fitted.problem.effects.labels or fitted.effect(label).plane != "pupil":
        return None
    columns, parameters = fitted.columns_of(label), fitted.effect(label).parameters
    angle, side = direction_among(parameters), fitted.x[0, columns].numpy().copy()
    if angle is None or side[0] <= parameters[0].lower + AT_REST:
        return None
    side[angle] += np.pi
    own, effects = fitter.of(final.stack, fitted.views), fitted.continued_by_label()
    effects[label] = begun_at(effects[label], side)
    other = own.explored([*effects.values()], fitted)
    rise = own.rise_between(fitted, other)
    turned = float((other.x - fitted.x)[0, columns[angle]])
    if not np.isfinite(other.chi2) or np.cos(turned) >= 0 or rise >= sure**2:
        return None
    base, values = other.effect(label).base, other.values_of(label)
    public = base.describe(values)
    change_nm = float(np.linalg.norm((other.modes_nm - fitted.modes_nm)[POINTING:]))
    return OppositeSide(public, base.phrase(public), rise, change_nm)


def open_facts(final: Optimum, known: Sequence[str]) -> list[FixedEffect]:
    """Return those facts of the `final` model that are off by more than `WORTH`.

    They are as they fit best, nothing free; those with `known` labels, named or adjusted, are left out.
    """
    fitted, found = final.fitted, []
    for label in fitted.problem.effects.labels:
        effect, columns = fitted.effect(label), fitted.columns_of(label)
        sigma = fitted.solution.covariance[0].diagonal()[columns] ** 0.5
        rows = zip(effect.parameters, fitted.x[0, columns].tolist(), sigma.tolist(), strict=True)
        off = any(p.null is not None and abs(value - p.null) > WORTH * error for p, value, error in rows)
        if effect.base.varies and label not in known and off:
            found.append(FixedEffect(effect.base, fitted.values_of(label)))
    return found
