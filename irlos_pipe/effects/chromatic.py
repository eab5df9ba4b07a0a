"""Wavefronts that depend on the light: `chromatic_ncpa` by wavelength, `filter_ncpa` by filter or lens.

The static wavefront of a recording is ::

    OPD(λ) = Σ a_i Z_i + (λ − λ₀) Σ c_i Z_i + Σ f_i Z_i

with the common NCPAs a, the slope c that glass adds about the wavelength λ₀ at which they are stated, and
the wavefront f of its own filter or lens. A narrow band shows the sum; a broad one, or recordings through
several filters and lenses, show the parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, Public, number
from irlos_pipe.effects.wavefront import OpdMap, ZernikeTable
from irlos_pipe.optics.grids import PupilGrid

UM = 1e-6
CHROMATIC_NOLLS = range(4, 67)  # to the tenth order; tip and tilt are `atmospheric_dispersion`
FILTER_NOLLS = range(5, 67)  # the focus of a lens is that of the star, in recordings of one focus
SEARCHED = 21  # last mode by which a diagnosis distinguishes it from other effects
BROAD_NM = 100.0  # from the shortest wavelength to the longest, from which a slope shows
OF_LAW = 1.0  # prior: a slope per µm, and a filter, of as much as the law of the NCPAs gives
WITHOUT_LAW_NM = 30.0


class _Table(ZernikeTable, OpdMap):
    """Modes whose prior follows the law of the NCPAs."""

    default: ClassVar[range]

    def __init__(self, nolls: Sequence[int], law: NcpaLaw | None = None):
        super().__init__(nolls)
        sigma = np.full(len(self.nolls), WITHOUT_LAW_NM) if law is None else OF_LAW * law.sigma_nm(self.nolls)
        self.parameters = tuple(
            replace(one, prior_sigma=float(s)) for one, s in zip(self.parameters, sigma, strict=True)
        )

    @classmethod
    def variants(cls, conditions: Conditions) -> tuple[Effect, ...]:
        """See `Effect.variants`: fewer modes distinguish it from other effects."""
        return (cls.under(conditions, range(cls.default.start, SEARCHED + 1)),)

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        return torch.tensordot(values, torch.tensor(grid.modes(self.nolls)), 1) * self._share(grid)

    def _map_slopes(self, values: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> Sequence[Tensor]:
        return [one * self._share(grid) for one in torch.tensor(grid.modes(self.nolls)[list(wanted)])]

    def _share(self, grid: PupilGrid) -> Tensor | float:
        """Of the table at the wavelengths of the `grid`."""
        raise NotImplementedError


class ChromaticNcpa(_Table):
    """Aberrations in proportion to wavelength: lenses, windows and prisms of glass.

    The NCPAs are those at the reference wavelength, and each mode changes by its slope per µm from there.
    In a narrow band the slope is a part of the NCPAs.

    Parameters
    ----------
    reference_nm : float
        Wavelength at which it vanishes.
    law : NcpaLaw, optional
        Of the prior, per µm.
    """

    name, table, default = "chromatic_ncpa", "zernike_nm_per_um", CHROMATIC_NOLLS
    formula = "Φ(λ) = Φ + (λ − λ_ref) Σ c_k Z_k, λ_ref = reference_nm"
    aberration = True
    public = (Public(table, "Noll index: nm RMS per µm", "zernike", -2000.0, 2000.0),)
    options = (
        Public("nolls", "Noll indices to estimate", "nolls"),
        number("reference_nm", "nm, where it vanishes; that of the NCPAs if left out", 300.0, 5000.0),
    )
    coefficient = Parameter("", "nm/µm", 0.0, 0.0, WITHOUT_LAW_NM, plausible=(-1000.0, 1000.0))
    sentence = "aberrations that change by {size:.0f} nm RMS per µm of wavelength"
    look_alike = "atmospheric_dispersion and a copy of the star; an NCPA, exactly, in a narrow band"
    reference = "Born & Wolf 1999, Principles of Optics, section 4.7"

    def __init__(self, nolls: Sequence[int], reference_nm: float, law: NcpaLaw | None = None):
        super().__init__(nolls, law)
        self.reference_nm = reference_nm

    @classmethod
    def under(
        cls, conditions: Conditions, nolls: Sequence[int] = (), reference_nm: float | None = None
    ) -> ChromaticNcpa:
        """See `Effect.under`: by default about the wavelength of the NCPAs."""
        return cls(nolls or cls.default, reference_nm or conditions.reference_nm, conditions.ncpa_law)

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        """See `Effect.shown_by`: bands that are broad or apart."""
        reach = [nm for one in recordings for nm, _ in one.settings.spectrum]
        return max(reach) - min(reach) > BROAD_NM

    def _share(self, grid: PupilGrid) -> Tensor:
        return (grid.wavelengths_m - self.reference_nm * 1e-9) / UM

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> None:
        """See `Effect.opd_nm`: nothing, at the wavelength of the NCPAs."""


class FilterNcpa(_Table):
    """The wavefront of one filter or lens, against that of recordings without it.

    It acts in recordings through every one of some `elements`: names of filters and of sources of diversity.

    Parameters
    ----------
    law : NcpaLaw, optional
        Of the prior.
    """

    name, table, default = "filter_ncpa", "zernike_nm", FILTER_NOLLS
    formula = "Φ → Φ + Σ c_k Z_k in recordings through the filter or lens"
    aberration = True
    repeatable = True
    public = (Public(table, "Noll index: nm RMS", "zernike", -2000.0, 2000.0),)
    options = (
        Public("nolls", "Noll indices to estimate", "nolls"),
        Public("of", "filter or source of diversity; both of the recording if left out", "word"),
    )
    coefficient = Parameter("", "nm", 0.0, 0.0, WITHOUT_LAW_NM, plausible=(-300.0, 300.0))
    sentence = "a wavefront of the filter or lens of {size:.0f} nm RMS"
    look_alike = "an NCPA, exactly, but for a recording through another filter or lens"
    reference = "Paxman, Schulz & Fienup 1992, J. Opt. Soc. Am. A 9, 1072: joint fits of several recordings"

    def __init__(self, nolls: Sequence[int], elements: Sequence[str], law: NcpaLaw | None = None):
        super().__init__(nolls, law)
        self.elements, self.law = frozenset(elements), law

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = (), of: str = "") -> FilterNcpa:
        """See `Effect.under`: by default of the filter and the lens of the recording together."""
        elements = (of,) if of else conditions.elements
        return cls(nolls or cls.default, elements, conditions.ncpa_law)

    @property
    def of(self) -> str:
        """The filter or source of diversity that it belongs to; empty where these are several."""
        return next(iter(self.elements)) if len(self.elements) == 1 else ""

    def with_focus(self) -> FilterNcpa:
        """Return the same with Noll 4, which recordings of known focus show; chosen modes stay."""
        if self.nolls != tuple(self.default):
            return self
        return FilterNcpa((4, *self.nolls), tuple(self.elements), self.law)

    def lies_in(self, conditions: Conditions) -> bool:
        """Whether the light of a recording taken under `conditions` passes the elements."""
        return self.elements <= set(conditions.elements)

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        """See `Effect.shown_by`: recordings with and without the elements."""
        return len({self.lies_in(one) for one in recordings}) == 2

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: nothing, in recordings without the elements."""
        return self if self.lies_in(here) else _Absent(self)

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        return FixedEffect(self.seen_in(now, now), values)

    def _share(self, grid: PupilGrid) -> float:
        return 1.0


class _Absent(FilterNcpa):
    """The wavefront of a filter or lens in a recording without it."""

    def __init__(self, effect: FilterNcpa):
        self.nolls, self.elements, self.parameters = effect.nolls, effect.elements, effect.parameters

    def _share(self, grid: PupilGrid) -> float:
        return 0.0
