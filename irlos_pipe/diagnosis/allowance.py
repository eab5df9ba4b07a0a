"""A search whose variances allow for what its model misses, and whose wavefront is as open as the window.

Light that a model has in the wrong place is no noise: names earned by it are none. What a model misses is
measured, as χ²/ν and as fine structure that only the flat explains, and enters the variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from irlos_pipe.conventions.units import resolution_px
from irlos_pipe.diagnosis.checks.fine_structure import flat_rms
from irlos_pipe.diagnosis.checks.noise import PHOTONS
from irlos_pipe.diagnosis.cube import Errors, Stacks
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.forward import Task
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.opening import Opening
from irlos_pipe.effects import Effect
from irlos_pipe.optics.psf_settings import PsfSettings

KNOWN = 1.2  # χ²/ν up to which photons still set the errors


@dataclass(frozen=True)
class AllowingTask(Task):
    """A search beside variances that allow for what a model misses.

    Attributes
    ----------
    kind : str
        Of the noise.
    flat_rms : float
        Error of the flat, the least that a model left: a wrong one makes fine structure of its own.
    misfit : float
        χ²/ν for which the variances allow.
    all_modes : Opening or None
        The last fit of all visible modes, of which the light paths have those beyond the closed basis.
    """

    kind: str
    flat_rms: float = np.inf
    misfit: float = np.inf
    all_modes: Opening | None = None

    def with_errors(self, fitted: Fitted) -> tuple[Self, Optimum]:
        """The search that allows for what a model misses, and the model fitted again under it."""
        task = self.allowing(fitted)
        again = task.fitter.explored(fitted.continued(), fitted)
        fitted = again if np.isfinite(again.chi2) else fitted
        task = task.allowing(fitted)
        self.report(1)
        return task, Optimum(task.cube.training, task.fitter.at(fitted))

    def allowing(self, fitted: Fitted) -> Self:
        """The same search beside variances that allow for what a model misses."""
        errors = self.errors_of(fitted)
        known = self.kind == PHOTONS and errors.misfit < KNOWN
        cube = self.cube.with_errors(errors).limited_by(known)
        fitter = self.fitter.of(cube.training)
        return replace(self, cube=cube, fitter=fitter, flat_rms=errors.flat_rms, misfit=errors.misfit)

    def errors_of(self, fitted: Fitted) -> Errors:
        """See `errors_of`."""
        return errors_of(self.cube.training, fitted, self.conditions.settings, self.flat_rms)

    def opened(self, current: Optimum) -> tuple[Self, Optimum]:
        """The search, and its model, with the wavefront beyond the fitted modes as all visible modes have it.

        One fit of all modes finds it; from there on it is known, which keeps every further fit as quick as
        before. Several recordings keep the modes that they have.
        """
        opening = self.opening(current.fitted, current.fitted.continued())
        return (self, current) if opening is None else self.closed(opening)

    def opening(self, near: Fitted, effects: Sequence[Effect]) -> Opening | None:
        """A fit of all visible modes beside some effects, see `Opening.of`."""
        before = self.all_modes
        known_nm, law = ({}, None) if before is None else (before.beyond_nm, before.law)
        unknown = {noll: -nm for noll, nm in known_nm.items()}
        views = [view.with_known(unknown) for view in self.fitter.views]
        fitter = self.fitter.of(self.cube.training, views)
        return Opening.of(fitter, effects, near, known_nm, law)

    def closed(self, opening: Opening) -> tuple[Self, Optimum]:
        """The search, and its model, with the modes beyond the closed basis as a fit of all has them."""
        known = opening.with_known_modes()
        fitter = self.fitter.of(self.cube.training, known.views)
        task = replace(self, fitter=fitter, all_modes=opening)
        return task.with_errors(task.fitter.at(known))


def errors_of(stack: Stacks, fitted: Fitted, settings: PsfSettings, most_flat: float = np.inf) -> Errors:
    """What flat and model miss, with which in the variances χ²/ν is one.

    Parameters
    ----------
    stack : Stacks
    fitted : Fitted
    settings : PsfSettings
        Of the first recording.
    most_flat : float
        Error of the flat that it can have at most.
    """
    residual_e = stack.mean_e - fitted.image_e
    pairs = zip(stack.parts, fitted.problem.pixels, strict=True)
    flat = min(most_flat, max(flat_rms(part, residual_e[pixels], settings) for part, pixels in pairs))
    across_px = resolution_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    errors = Errors(alike_px=max(1.0, np.pi / 4 * across_px**2), flat_rms=flat)
    white = residual_e * stack.with_errors(errors).root
    return replace(errors, misfit=max(1.0, float(white @ white) / fitted.problem.freedom))
