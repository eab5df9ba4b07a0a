"""Image models with their images in a table, for many fits of tip, tilt and focus with one light path.

The focus curve says how well an image is explained at every defocus, and by the twin of the best fit.
A centro-symmetric pupil without known diversity gives +d and −d the same image, see `starts`. The curve shows
whether the diversity has told the two apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.image_fit import Layout
from irlos_pipe.estimate.lift import PhotonFit, lift
from irlos_pipe.estimate.starts import SCAN_NM
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.solver import solve
from irlos_pipe.optics.focus_table import FocusTable, Reach, can_tabulate, is_family, place_of_focus

FOCUS_REACH_NM = 400.0  # beyond the starts: few fits move further
TILT_REACH_NM = 250.0  # beyond the starts, between two and three pixels


class TabulatedModel(ImageModel):
    """An `ImageModel` without free parameters, quick within a reach."""

    def __init__(self, general: ImageModel, reach: Reach):
        psf = FocusTable(general.psf, general.optics, reach)
        detector = [effect for effect, _ in general.effects.at("detector")]
        super().__init__(psf, EffectSet(detector, general.psf.grids))
        self._general = general

    @property
    def general(self) -> ImageModel:
        """What was tabulated."""
        return self._general


def tabulated(model: ImageModel, start_nm: torch.Tensor) -> ImageModel:
    """A quick version of `model` about `start_nm`, (images, modes); `model` itself where there is none.

    There is one if the modes are tip, tilt and one more, if no effect is free or changes with time, and
    if the images are well sampled.
    """
    if model.general is not model or model.effects.parameters or model.effects.at("time"):
        return model
    if not is_family(model.psf.nolls) or model.psf.settings.lenslets > 1:
        return model
    # well beyond the starts, wide enough for the scan of `scan_start_nm` too
    nolls, focus = model.psf.nolls, start_nm[:, place_of_focus(model.psf.nolls)]
    low = min(float(focus.min()) - FOCUS_REACH_NM, SCAN_NM[0])
    high = max(float(focus.max()) + FOCUS_REACH_NM, SCAN_NM[-1])
    tilts = start_nm[:, [nolls.index(2), nolls.index(3)]]
    reach = Reach((low, high), float(tilts.abs().max()) + TILT_REACH_NM)
    return TabulatedModel(model, reach) if can_tabulate(model.psf, model.optics, reach) else model


CURVE_NM = np.linspace(-900.0, 900.0, 37)
HELD_NM = 0.01  # width of the prior that holds the defocus
APART_NM = 75.0  # solutions closer than this are one
MOST_MINIMA = 4  # minima of the curve from which free fits start, at most


@dataclass(frozen=True)
class FocusCurve:
    """χ²/ν of an image against its defocus, everything else fitted."""

    focus_nm: np.ndarray  # (values,), held [nm RMS]
    chi2_nu: np.ndarray  # (values,), of the best fit with it
    best_nm: float  # of the best fit, and its χ²/ν
    best_chi2_nu: float
    twin_nm: float = np.nan  # of the best of the other minima, and its χ²/ν; NaN where there is none
    twin_chi2_nu: float = np.nan
    delta_chi2: float = np.nan  # χ² of that minus χ² of the best fit

    @property
    def evidence(self) -> float:
        """Of the image against the twin: the difference in units of the misfit that the best fit leaves."""
        return self.delta_chi2 / max(1.0, self.best_chi2_nu)


def focus_curve(
    model: ImageModel,
    image_e: torch.Tensor,
    good: torch.Tensor,
    noise: NoiseModel,
    modes_nm: torch.Tensor,
) -> FocusCurve:
    """Fit an image with its defocus held at the values of `CURVE_NM`, and freely from the minima of that.

    The effects of the `model` have no free parameters; all fits of `image_e` on the `good` pixels (rows,
    columns) start from the best one, `modes_nm` (modes,).
    """
    column = model.psf.nolls.index(DEFOCUS)
    starts = modes_nm.repeat(len(CURVE_NM) + 1, 1)
    starts[:-1, column] = torch.as_tensor(CURVE_NM)
    quick = tabulated(model.general, starts)
    sigma_nm = torch.full_like(modes_nm, torch.inf)
    sigma_nm[column] = HELD_NM
    options = LiftOptions(prior_mean_nm=starts, prior_sigma_nm=sigma_nm)
    # Far from the focus, tip and tilt may run to the end of the table: a curve needs no more than that.
    held = lift(quick, image_e.repeat(len(starts), 1, 1), good, noise, starts, options, beyond=False)
    chi2_nu = held.chi2_nu[:-1].numpy()
    images = image_e.double().flatten().repeat(MOST_MINIMA + 1, 1, 1).to(quick.psf.device)
    begin = held.solution.values[[-1, *_minima(chi2_nu)]]
    problem = PhotonFit(quick, Layout(quick.psf.nolls), images[: len(begin)], good.flatten(), noise)
    free = solve(problem, begin, max_iterations=options.max_iterations)
    focus_nm, objective = free.values[:, column].numpy(), free.objective.numpy()
    free_chi2_nu = problem.reduced_chi2_of(problem.predict_all(free.values)).tolist()
    best = FocusCurve(CURVE_NM, chi2_nu, float(focus_nm[0]), free_chi2_nu[0])
    apart = (np.abs(focus_nm - focus_nm[0]) > APART_NM) & (np.abs(focus_nm) < CURVE_NM.max())
    if not apart.any():
        return best
    twin = np.where(apart, objective, np.inf).argmin()
    delta_chi2 = 2 * float(objective[twin] - objective[0])
    return replace(
        best, twin_nm=float(focus_nm[twin]), twin_chi2_nu=free_chi2_nu[twin], delta_chi2=delta_chi2
    )


def _minima(values: np.ndarray) -> Sequence[int]:
    """Positions of the lowest minima of a curve; ends do not count."""
    inside = values[1:-1]
    found = 1 + np.nonzero((inside < values[:-2]) & (inside <= values[2:]))[0]
    return found[np.argsort(values[found])][:MOST_MINIMA].tolist()
