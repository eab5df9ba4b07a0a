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
from irlos_pipe.estimate.open_fit import JOINED
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import PsfSettings


@dataclass(frozen=True)
class Screened:
    """A pixel that the screening of the frames masked and no map lists."""

    row: int
    column: int
    mean_e: float  # mean over the frames of what it showed, background subtracted [e-]


@dataclass(frozen=True)
class Exposures:
    """Frames that were taken under the same conditions."""

    frames: Frames  # in order of time
    conditions: Conditions  # introduced defocus in the known wavefront of its settings
    screened: Sequence[Screened] = ()  # pixels masked in the frames because of what they showed there
    moment: int = 0  # number of the moment: recordings of another one are of another star or night
    name: str = ""  # of the moment, for people
    star: str = ""  # of the moment: equal names are the same star

    def view(self, nolls: Sequence[int], device: str) -> View:
        """Its model of the modes `nolls` on `device`."""
        return View(_path(self.conditions.settings, nolls, device), self.conditions, self.moment)


def _path(settings: PsfSettings, nolls: Sequence[int], device: str) -> LightPath:
    """In float64, as a mean is more precise than float32; derivatives may be rough."""
    return light_path(settings, nolls, device=device, dtype=torch.float64, rough_derivatives=True)


@dataclass(frozen=True)
class View:
    """The light path of one recording, with the settings of its conditions, at one moment."""

    psf: LightPath
    conditions: Conditions
    moment: int = 0

    def with_modes(self, nolls: Sequence[int], *, few_colours: bool = False) -> View:
        """This light path with the modes `nolls`; of `few_colours`, its images are rough as well."""
        settings = self.psf.settings.with_fewer_colours(JOINED) if few_colours else self.psf.settings
        return replace(self, psf=_path(settings, nolls, self.psf.device))

    def with_known(self, modes_nm: Mapping[int, float]) -> View:
        """This light path with further modes of a known wavefront: Noll index to nm RMS."""
        psf, known = self.psf, self.psf.settings.known
        ncpa_nm = {noll: known.ncpa_nm.get(noll, 0.0) + nm for noll, nm in modes_nm.items()}
        settings = replace(psf.settings, known=replace(known, ncpa_nm={**known.ncpa_nm, **ncpa_nm}))
        return replace(self, psf=_path(settings, psf.nolls, psf.device))

    def under(self, conditions: Conditions) -> View:
        """A recording of the same modes under other `conditions`."""
        psf = _path(conditions.settings, self.psf.nolls, self.psf.device)
        return replace(self, psf=psf, conditions=conditions)

    def seen(self, effects: Sequence[Effect], views: Sequence[View]) -> list[Effect]:
        """Those of the `effects` that act in this recording, as they do.

        Each is stated for the first of the recordings, whose `views` are all given, in which it acts.
        """
        found = []
        for effect in (one for one in effects if one.acting(self.moment)):
            first = next(view for view in views if effect.acting(view.moment))
            same = first is self
            found.append(effect if same else effect.seen_in(self.conditions, first.conditions))
        return found
