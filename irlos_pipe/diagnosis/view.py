"""Ways of looking at the same aberrations: recordings that differ in known settings, in star or in night.

Focus, diversity and band of every recording are known; the static wavefront and the parameters of the
effects are common to all. In each recording an effect acts as its settings make it act.

A moment is one star at one time: its recordings share the sky and the wavefront. What belongs to the
instrument is common to all moments, what belongs to a star to all moments of that star.
"""

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

    def view(self, nolls: Sequence[int], device: str) -> "View":
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

    def with_modes(self, nolls: Sequence[int], *, few_colours: bool = False) -> "View":
        """This light path with the modes `nolls`; of `few_colours`, its images are rough as well."""
        settings = self.psf.settings.with_fewer_colours(JOINED) if few_colours else self.psf.settings
        return replace(self, psf=_path(settings, nolls, self.psf.device))

    def with_known(self, modes_nm: Mapping[int, float]) -> "View":
        """This light path with further modes of a known wavefront: Noll index to nm RMS."""
        psf, known = self.psf, self.psf.settings.known
        ncpa_nm = {noll: known.ncpa_nm.get(noll, 0.0) + nm for noll, nm in modes_nm.items()}
        settings = replace(psf.settings, known=replace(known, ncpa_nm={**known.ncpa_nm, **ncpa_nm}))
        return replace(self, psf=_path(settings, psf.nolls, psf.device))

    def under(self, conditions: Conditions) -> "View":
        """A recording of the same modes under other `conditions`."""
        psf = _path(conditions.settings, self.psf.nolls, self.psf.device)
        return replace(self, psf=psf, conditions=conditions)

    def seen(self, effects: Sequence[Effect], views: "Sequence[View]") -> list[Effect]:
        """Those of the `effects` that act in this recording, as they do.

        Each is stated for the first of the recordings, whose `views` are all given, in which it acts.
        """
        found = []
        for effect in (one for one in effects if one.acting(self.moment)):
            first = next(view for view in views if effect.acting(view.moment))
            same = first is self
            found.append(effect if same else effect.seen_in(self.conditions, first.conditions))
        return found


Placement = frozenset[int] | None  # moments in which an effect acts; None: all


@dataclass(frozen=True)
class Moment:
    """One star at one time."""

    name: str  # for people
    star: str  # equal names are the same star
    conditions: Conditions  # of its first recording


@dataclass(frozen=True)
class Moments:
    """All moments, by number."""

    by_number: Mapping[int, Moment]

    @classmethod
    def of(cls, recordings: Sequence[Exposures]) -> "Moments":
        by_number: dict[int, Moment] = {}
        for one in recordings:
            by_number.setdefault(one.moment, Moment(one.name, one.star, one.conditions))
        return cls(by_number)

    @property
    def several(self) -> bool:
        return len(self.by_number) > 1

    @property
    def by_star(self) -> dict[str, frozenset[int]]:
        """Moments of every star."""
        stars = dict.fromkeys(one.star for one in self.by_number.values())
        return {star: frozenset(n for n, one in self.by_number.items() if one.star == star) for star in stars}

    @property
    def each(self) -> list[frozenset[int]]:
        """Every moment by itself."""
        return [frozenset({number}) for number in self.by_number]

    def conditions_of(self, placement: Placement) -> Conditions:
        """Conditions of the first of the moments in which an effect acts."""
        number = next(n for n in self.by_number if placement is None or n in placement)
        return self.by_number[number].conditions

    def names_of(self, placement: Placement) -> list[str]:
        """Names of the moments in which an effect acts."""
        return [one.name for n, one in self.by_number.items() if placement is None or n in placement]

    def placements(self, kind: type[Effect] | Effect) -> list[Placement]:
        """Where effects of a `kind` are looked for: with what they belong to.

        What belongs to the instrument is common to all moments; one moment may still be alone in showing it.
        """
        if kind.belongs_to == "instrument":
            return [None, *(self.each if self.several else ())]
        return self.own_placements(kind)

    def own_placements(self, kind: type[Effect] | Effect) -> list[Placement]:
        """Where effects of a `kind` that are no instrument's have values of their own: per star or moment."""
        own = list(self.by_star.values()) if kind.belongs_to == "star" else self.each
        return [None] if len(own) == 1 else [*own]


def placed(by_moment: Mapping[int, Sequence[Effect]], moments: Moments) -> list[Effect]:
    """The effects of a model of several moments.

    For every moment `by_moment` has the same effects, as its conditions make them. What belongs to the
    instrument or is held is returned once, what belongs to a star or a moment for each of these.
    """
    found: list[Effect] = []
    for alike in zip(*by_moment.values(), strict=True):
        first, numbered = alike[0], dict(zip(by_moment, alike, strict=True))
        if first.belongs_to == "instrument" or not first.parameters:
            found.append(first)
            continue
        for placement in moments.own_placements(first):
            number = next(n for n in numbered if placement is None or n in placement)
            found.append(numbered[number].only_in(placement))
    return found
