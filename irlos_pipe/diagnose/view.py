"""Ways of looking at the same aberrations: recordings that differ in known settings.

Focus, diversity and band of every recording are known; the static wavefront and the parameters of the
effects are common to all. In each recording an effect acts as its settings make it act.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects import Conditions, Effect, FixedEffect
from irlos_pipe.effects.colour import Spectrum
from irlos_pipe.effects.seeing_halo import ScaledHalo, SeeingHalo
from irlos_pipe.effects.wavefront import DiversityError
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings


@dataclass(frozen=True)
class Screened:
    """A pixel that the screening of the frames masked and no map lists.

    Attributes
    ----------
    row, column : int
    mean_e : float
        Mean over the frames of what it showed, background subtracted [e-].
    """

    row: int
    column: int
    mean_e: float


@dataclass(frozen=True)
class Exposures:
    """Frames that were taken alike.

    Attributes
    ----------
    frames : Frames
        In order of time.
    settings : PsfSettings
        Introduced defocus included in the diversity.
    conditions : Conditions
    screened : sequence of Screened
        Pixels masked in the frames because of what they showed there.
    """

    frames: Frames
    settings: PsfSettings
    conditions: Conditions
    screened: Sequence[Screened] = ()

    def view(self, nolls: Sequence[int], device: str) -> View:
        """Its model, in float64: the mean image is more precise than float32."""
        return View(PsfModel(self.settings, nolls, device=device, dtype=torch.float64), self.conditions)


@dataclass(frozen=True)
class View:
    """The light path of one recording."""

    psf: PsfModel
    conditions: Conditions

    def quick(self) -> View:
        """The same in float32: good enough to find the way."""
        psf = PsfModel(self.psf.settings, self.psf.nolls, device=self.psf.device, dtype=torch.float32)
        return View(psf, self.conditions)

    def seen(self, effect: Effect, first: View) -> Effect:
        """An effect that is stated for the `first` recording as it acts in this one."""
        if first is self:
            return effect
        if isinstance(effect, FixedEffect):
            free = [effect.base.parameters[i].name for i in effect.free]
            return FixedEffect(self.seen(effect.base, first), effect.values, free)
        if isinstance(effect, DiversityError):
            return DiversityErrorHere(self.conditions.diversity, effect.diversity)
        if self.conditions.spectrum == first.conditions.spectrum:
            return effect
        return self._in_its_own_band(effect)

    def _in_its_own_band(self, effect: Effect) -> Effect:
        """A spectrum is that of its filter; a halo keeps numbers per wavelength, so each band has its own."""
        if isinstance(effect, Spectrum):
            return ElsewhereOnly(effect)
        if isinstance(effect, ScaledHalo):
            return ScaledHalo(self._in_its_own_band(effect.halo))
        return SeeingHalo.under(self.conditions) if isinstance(effect, SeeingHalo) else effect


class DiversityErrorHere(DiversityError):
    """The same fraction of another diversity: a recording without diversity has no error of it.

    Parameters
    ----------
    diversity, first : dict of int to float
        As introduced in this recording, and in the one for which the error is stated, Noll: nm RMS.
    """

    def __init__(self, diversity: dict[int, float], first: dict[int, float]):
        self.diversity, self.first_nm = dict(diversity), float(np.linalg.norm(list(first.values())))

    def _map_nm(self, values: torch.Tensor, grid) -> torch.Tensor:
        total = np.zeros_like(grid.amplitude)
        for noll, nm in self.diversity.items():
            total = total + nm / self.first_nm * grid.modes([noll])[0]
        return values[0] * torch.as_tensor(total)


class ElsewhereOnly(Effect):
    """An effect of another recording, of which this one shows nothing."""

    def __init__(self, effect: Effect):
        self.name, self.place, self.order = effect.name, effect.plane, effect.order
        self.parameters = effect.parameters

    def apply(self, values: torch.Tensor, light, *rest):
        """`light` as it is."""
        return light
