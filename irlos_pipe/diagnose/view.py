"""Ways of looking at the same aberrations: recordings that differ in known settings.

Focus, diversity and band of every recording are known; the static wavefront and the parameters of the
effects are common to all. In each recording an effect acts as its settings make it act.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from irlos_pipe.effects import Conditions, Effect
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf import PsfModel


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
    conditions : Conditions
        Introduced defocus in the known wavefront of its settings.
    screened : sequence of Screened
        Pixels masked in the frames because of what they showed there.
    """

    frames: Frames
    conditions: Conditions
    screened: Sequence[Screened] = ()

    def view(self, nolls: Sequence[int], device: str) -> View:
        """Its model of the modes `nolls` on `device`, in float64: a mean is more precise than float32."""
        psf = PsfModel(self.conditions.settings, nolls, device=device, dtype=torch.float64)
        return View(psf, self.conditions)


@dataclass(frozen=True)
class View:
    """The light path of one recording, with the settings of its conditions."""

    psf: PsfModel
    conditions: Conditions

    def quick(self) -> View:
        """This light path in float32, which is precise enough for most of a fit."""
        psf = self.psf
        return View(
            PsfModel(psf.settings, psf.nolls, device=psf.device, dtype=torch.float32), self.conditions
        )

    def with_known(self, modes_nm: Mapping[int, float]) -> View:
        """This light path with further modes of a known wavefront: Noll index to nm RMS."""
        psf, known = self.psf, self.psf.settings.known
        ncpa_nm = {noll: known.ncpa_nm.get(noll, 0.0) + nm for noll, nm in modes_nm.items()}
        settings = replace(psf.settings, known=replace(known, ncpa_nm={**known.ncpa_nm, **ncpa_nm}))
        return View(PsfModel(settings, psf.nolls, device=psf.device, dtype=psf.dtype), self.conditions)

    def under(self, conditions: Conditions) -> View:
        """A recording of the same modes under other `conditions`."""
        psf = self.psf
        return View(PsfModel(conditions.settings, psf.nolls, device=psf.device, dtype=psf.dtype), conditions)

    def seen(self, effect: Effect, first: View) -> Effect:
        """`effect`, stated for the `first` recording, as it acts in this one."""
        return effect if first is self else effect.seen_in(self.conditions, first.conditions)
