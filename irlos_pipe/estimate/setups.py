"""NCPA calibration from several set-ups: planes of known defocus, bands, filters, lenses, diversities.

The mean images of all set-ups are fitted together. The modes and the effects of the wavefront, among them
what depends on wavelength, filter and lens, are common; tip and tilt, flux and background belong to each
set-up, and the effects of star and sky to each source: planes of one recording show the same star.

An error of the model makes set-ups contradict each other: errors grow by the scatter of what each of them
by itself wants, over its expectation (the covariance of clusters; Liang & Zeger 1986, Biometrika 73, 13).

An introduced defocus d_i is off by e_i, Gaussian of standard deviation a s_i, a parameter of its own; s_i is
d_i, or the RMS of all where that is larger, as what is set also has a zero point. The accuracy a that makes
the images likeliest is ``a² = Σ (e_i / s_i)² / Σ (1 − var(e_i) / (a s_i)²)``: squares of the errors over how
many of them the images determine (MacKay 1992, Neural Computation 4, 415).
"""

import math
import time
from collections.abc import Callable, Hashable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import MISFIT, Calibration, SetupFit, calibrate, result_of
from irlos_pipe.estimate.calibration_errors import NominalChi2, Part, nominal_chi2, public_errors
from irlos_pipe.estimate.calibration_options import CalibrationOptions, TwinCheck
from irlos_pipe.estimate.cube import Frames, covariance_of_mean, mean_variance_e2
from irlos_pipe.estimate.image_fit import ImageFit, JoinedFit, Layout, whole_wavefront
from irlos_pipe.estimate.methods import MEAN_IMAGE, CubeFit, start_at_centroids
from irlos_pipe.estimate.starts import check_twin
from irlos_pipe.numerics.solver import Solution, solve
from irlos_pipe.optics.psf_settings import PsfSettings

POINTING = len(TIP_TILT)  # the first modes
FOCUSED = POINTING + 1  # those and defocus
TWIN_ITERATIONS = 80  # planes exclude the twin: its fit goes back a long way to the solution
LEAST_SETUPS = 3  # set-ups from which they can contradict each other
# accuracy of introduced defoci, as a part of them: where the search begins, and its limits
FIRST, LEAST, LARGEST = 0.1, 1e-4, 0.3
ROUNDS, CLOSE = 12, 0.2  # to find it, and how close, as a part of it


@dataclass(frozen=True)
class Setup:
    """Frames that were taken in the same way."""

    frames: Frames
    settings: PsfSettings
    # those of the wavefront as they act here, in the same order in every set-up
    common: Sequence[Effect] = ()
    own: Sequence[Effect] = ()  # those of star and sky
    # recordings of the frames; set-ups of the same ones, planes, share star and sky
    names: tuple[str, ...] = ()

    @property
    def introduced_nm(self) -> float:
        """Defocus that was introduced."""
        return self.settings.known.introduced_nm.get(DEFOCUS, 0.0)


def is_common(effect: Effect) -> bool:
    """Return whether an effect belongs to the wavefront or the instrument, and not to star and sky."""
    return effect.belongs_to == "instrument" and effect.instrumental


class SetupsFit(JoinedFit):
    """Mean images of several set-ups, `parts` of the same modes, by one vector; one member.

    Introduced defoci are known to a part, `accuracy`, of them or of their RMS, whichever is larger: `off_nm`.
    """

    def __init__(self, setups: Sequence[Setup], parts: Sequence[ImageFit]):
        place: dict[Hashable, int] = {}
        columns: list[list[int]] = []
        changes: list[dict[int, int]] = [{} for _ in parts]
        self.accuracy, self.off_nm = FIRST, {}
        introduced_nm = [setup.introduced_nm for setup in setups if setup.introduced_nm]
        usual_nm = float(np.sqrt(np.mean(np.square(introduced_nm or [0.0]))))
        for number, (setup, part) in enumerate(zip(setups, parts, strict=True)):
            columns.append([place.setdefault(key, len(place)) for key in _keys(number, setup, part)])
            if setup.introduced_nm:
                off = place.setdefault(("off", number), len(place))
                changes[number] = {FOCUSED - 1: off}
                self.off_nm[off] = max(abs(setup.introduced_nm), usual_nm)
        sigma_nm = {column: FIRST * nm for column, nm in self.off_nm.items()}
        super().__init__(parts, columns, changes, sigma_nm)
        self.parts = tuple(
            part._with(has_prior=False, prior_precision=0 * part.prior_precision) for part in parts
        )
        self.same_unit = self.layout.modes

    def known_to(self, accuracy: float) -> Self:
        """Return the same fit with introduced defoci that are known to another `accuracy`."""
        other = copy(self)
        other.accuracy, other.prior_precision = accuracy, self.prior_precision.clone()
        for column, nm in self.off_nm.items():
            other.prior_precision[:, column] = (accuracy * nm) ** -2
        return other

    def twin(
        self, setups: Sequence[Setup], solution: Solution, law: NcpaLaw | None
    ) -> tuple[TwinCheck, Solution]:
        """Return the comparison with the twin, and this: see `check_twin`.

        It begins where all set-ups like it best, by the mean of what was introduced in them.
        """
        known = [setup.settings.known.total_nm for setup in setups]
        mean = {noll: sum(one.get(noll, 0.0) for one in known) / len(known) for noll in set().union(*known)}
        return check_twin(self, solution, law, mean, TWIN_ITERATIONS)


def _keys(number: int, setup: Setup, part: ImageFit) -> list[Hashable]:
    """What the parameters of a part are; those with the same key are one parameter."""
    keys: list[Hashable] = [
        ("mode", noll, number if index < POINTING else 0) for index, noll in enumerate(part.layout.nolls)
    ]
    common = {id(effect): index for index, effect in enumerate(setup.common)}
    source = setup.names or number
    own = {id(effect): index for index, effect in enumerate(setup.own)}
    for effect in part.model.effects.effects:
        at = ("common", common[id(effect)]) if id(effect) in common else ("own", source, own[id(effect)])
        keys += [(*at, index) for index in range(len(effect.parameters))]
    return [*keys, ("flux", number), ("background", number)]


def calibrate_setups(
    setups: Sequence[Setup],
    options: CalibrationOptions,
    *,
    device: str = "cpu",
    note: Callable[[str], None] = lambda line: None,
) -> Calibration:
    """Estimate the static wavefront of recordings in several set-ups, in a closed basis.

    Window and pixel scale are the same in all `setups`; of the `options`, prior, number of modes and
    iterations count. The wavefront and its image are stated as the first set-up has it, with the standard
    errors of the effects; χ²/ν and its nominal value are those of all. `note` gets a line after every step.
    """
    began = time.perf_counter()
    closed = replace(options.resolved(), highest_noll=options.last_noll)
    parts = [_part(setup, closed, device) for setup in setups]
    problem = SetupsFit(setups, parts)
    solution = _from_none(setups, problem, closed, device)
    problem, solution = _likeliest_accuracy(problem, solution, closed.max_iterations)
    note(f"Noll 2 to {closed.last_noll} fitted to {len(setups)} set-ups together")
    twin, other = problem.twin(setups, solution, closed.law)
    if twin.delta_chi2 < 0:
        solution = other
        twin, _ = problem.twin(setups, solution, closed.law)
    note("compared with the twin")
    x = solution.values
    chi2_nu = problem.chi2(x) / problem.freedom
    covariance, changes, nominal = _errors(setups, problem, x, solution.covariance[0], chi2_nu)
    layout, effects, columns = problem.layout, parts[0].model.effects, torch.tensor(problem.own[0])
    own = x[:, columns]
    added, read = whole_wavefront(parts[0], own[0])
    values = own[0, layout.effect_values]
    mine = covariance[columns[:, None], columns]
    total = own[0, layout.modes] + added
    found = [
        _found(setup, part, problem.part(x, n), float(x[0, FOCUSED - 1]), device)
        for n, (setup, part) in enumerate(zip(setups, parts, strict=True))
    ]
    return result_of(
        [setup.frames for setup in setups],
        parts[0],
        own,
        torch.as_tensor(found[0].model_e),
        options=closed,
        zernike_nm=total.numpy(),
        covariance_nm2=(read @ mine @ read.mT).numpy(),
        errors_from="frames" if all(one.frames.show_scatter for one in setups) else "noise",
        frames_nm=(total + changes[:, columns] @ read.mT).numpy(),
        frame_status=solution.status,
        iterations=solution.iterations.numpy(),
        chi2_nu=chi2_nu,
        nominal=nominal,
        twin=twin,
        tail=None,
        seconds=time.perf_counter() - began,
        effects_sigma=public_errors(
            effects, values, mine[layout.effect_values, layout.effect_values].numpy()
        ),
        setups=found,
        introduced_accuracy=problem.accuracy if problem.off_nm else math.nan,
    )


def _from_none(
    setups: Sequence[Setup], problem: SetupsFit, options: CalibrationOptions, device: str
) -> Solution:
    """The fit from no aberrations; and where it misfits, the better of that and one from the first set-up."""
    starts = [start_at_centroids(s.frames, p) for s, p in zip(setups, problem.parts, strict=True)]

    def fitted() -> Solution:
        whole = problem.whole([start[0] for start in starts])[None]
        return solve(problem, whole, max_iterations=options.max_iterations)

    solution = fitted()
    if problem.chi2(solution.values) <= MISFIT * problem.freedom:
        return solution
    alone = calibrate(setups[0].frames, setups[0].settings, options, setups[0].own, device=device)
    for number, start in enumerate(starts):
        known = slice(POINTING if number else 0, len(alone.nolls))
        start[:, known] = torch.as_tensor(alone.fitted_modes_nm[known])
    return min(solution, fitted(), key=lambda one: float(one.objective[0]))


def _likeliest_accuracy(
    problem: SetupsFit, solution: Solution, max_iterations: int
) -> tuple[SetupsFit, Solution]:
    """The fit with the accuracy of introduced defoci that makes the images likeliest."""
    columns, off_nm = list(problem.off_nm), torch.tensor(list(problem.off_nm.values()), dtype=torch.float64)
    for _ in range(ROUNDS if columns else 0):
        errors = solution.values[0, columns] / off_nm
        variances = solution.covariance[0].diagonal()[columns] / off_nm**2
        determined = (1 - variances / problem.accuracy**2).sum().clamp_min(LEAST)
        found = float((errors.square().sum() / determined).sqrt().clamp(LEAST, LARGEST))
        done = abs(math.log(found / problem.accuracy)) < CLOSE
        problem = problem.known_to(found)
        solution = solve(problem, solution.values, max_iterations=max_iterations)
        if done:
            break
    return problem, solution


def _found(setup: Setup, part: ImageFit, x: torch.Tensor, common_nm: float, device: str) -> SetupFit:
    """What a set-up shows at the parameters `x` (1, its own), and what it says of its defocus by itself.

    All that is common is held, defocus at `common_nm`. It is looked for near the declared one and near that
    of the other sign: a plane whose sign is wrong would else stay where it is.
    """
    frames, settings, layout = setup.frames, setup.settings, part.layout
    beyond = dict(zip(layout.nolls[FOCUSED:], x[0, layout.modes].tolist()[FOCUSED:], strict=True))
    settings = replace(settings, known=replace(settings.known, ncpa_nm=beyond))
    psf = MEAN_IMAGE.psf_model(settings, layout.nolls[:FOCUSED], device)
    held = part.model.effects.held(x[0, layout.effect_values]).effects
    alone = part.posed(ImageModel(psf, held), Layout(psf.nolls))
    near = x[:, [*range(FOCUSED), -2, -1]]
    mirrored = near.clone()
    mirrored[:, FOCUSED - 1] *= -1
    mirrored[:, FOCUSED - 1] -= 2 * settings.known.total_nm.get(DEFOCUS, 0.0)
    best = min(
        (solve(alone, start, max_iterations=30) for start in (near, mirrored)),
        key=lambda one: float(one.objective[0]),
    )
    grown = max(1.0, float(alone.reduced_chi2(best.values)[0])) ** 0.5
    variance = mean_variance_e2(frames)
    mean, model = frames.mean_e, part.predict(x)[0].reshape(settings.window).cpu()
    return SetupFit(
        name=", ".join(setup.names),
        introduced_nm=settings.known.total_nm.get(DEFOCUS, 0.0),
        frames=len(frames.images_e),
        chi2_nu=float(((mean - model).square() / variance)[frames.good].sum()) / part.freedom,
        focus_nm=float(best.values[0, FOCUSED - 1]) - common_nm,
        focus_sigma_nm=float(best.sigma[0, FOCUSED - 1]) * grown,
        mean_e=mean.numpy(),
        model_e=model.numpy(),
        sigma_e=variance.sqrt().numpy(),
    )


def _part(setup: Setup, options: CalibrationOptions, device: str) -> ImageFit:
    """The mean image of a set-up."""
    psf = MEAN_IMAGE.psf_model(setup.settings, range(2, options.last_noll + 1), device)
    task = CubeFit(setup.frames, psf, CalibrationOptions(prior=options.prior))
    return task.problem([*setup.common, *setup.own])


def _errors(
    setups: Sequence[Setup], problem: SetupsFit, x: torch.Tensor, inverse: torch.Tensor, chi2_nu: float
) -> tuple[torch.Tensor, torch.Tensor, NominalChi2]:
    """Covariance of all parameters, the sum of what every set-up's noise makes of them, (size, size).

    It is that of the scatter of the frames, of few that of the weights; it grows by the misfit, or by how
    much set-ups contradict each other. `inverse` is that of the Hessian. With it go the changes of the
    parameters by each frame by itself, its set-up's mean taken out, (frames, size), and the nominal χ²/ν.
    """
    total = inverse @ torch.diag(problem.prior_precision[0]) @ inverse
    changes, wanted, images = [], [], []
    for number, (setup, part) in enumerate(zip(setups, problem.parts, strict=True)):
        image, jacobian = part.predict_and_jacobian(problem.part(x, number))
        weight = part.root_weight[0].double().mean(0) ** 2
        columns, jacobian = problem.columns[number], jacobian[0, problem.rows[number]].double()
        gain = inverse[:, columns] @ (jacobian * weight).cpu()
        series = setup.frames.responses(gain)
        wanted.append(gain @ (part.images[0, 0].double() - image[0]).cpu())
        if setup.frames.show_scatter:
            total += torch.as_tensor(covariance_of_mean(series.numpy()))
        else:
            total += gain @ jacobian.cpu().mT @ inverse[columns]
        changes.append(series)
        images.append(Part(setup.frames, jacobian, columns))
    nominal = nominal_chi2(images, problem.prior_precision[0])
    misfit = max(1.0, chi2_nu / nominal.value)
    if len(setups) >= LEAST_SETUPS:
        modes = problem.layout.modes.stop
        apart = torch.stack(wanted).var(dim=0)[POINTING:modes] * len(setups)
        misfit = max(misfit, float((apart / total.diagonal()[POINTING:modes]).mean()))
    return misfit * total, torch.cat(changes), nominal
