"""Modes in the pupil: `diversity_error`, `high_order_ncpa`, `amplitude_aberration`, `ncpa_drift`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, Public
from irlos_pipe.effects.planes import PupilEffect, TimeEffect
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.zernike import noll_to_nm

HIGH_ORDER_SIGMA_NM = 60.0
EXTRA_ORDERS = 2  # radial orders beyond the estimated modes, by default

UM = 1e-6
CHROMATIC_NOLLS = range(4, 67)  # to the tenth order; tip and tilt are `atmospheric_dispersion`
FILTER_NOLLS = range(5, 67)  # the focus of a lens is that of the star, in recordings of one focus
SEARCHED = 21  # last mode by which a diagnosis distinguishes it from other effects
BROAD_NM = 100.0  # from the shortest wavelength to the longest, from which a slope shows
OF_LAW = 1.0  # prior: a slope per µm, and a filter, of as much as the law of the NCPAs gives
WITHOUT_LAW_NM = 30.0
NOLLS = Public("nolls", "Noll indices to estimate", kind="nolls")


class ZernikeTable(Effect):
    """One parameter per mode; a base class jointly with that of the plane."""

    table: ClassVar[str]  # name of the public table
    coefficient: ClassVar[Parameter]  # of one mode, except its name
    options: tuple[Public, ...] = (NOLLS,)

    def __init__(self, nolls: Sequence[int]):
        self.nolls = tuple(int(noll) for noll in nolls)
        if len(set(self.nolls)) != len(self.nolls):
            raise ValueError(f"a Noll index occurs twice in {list(self.nolls)}")
        self.parameters = tuple(replace(self.coefficient, name=f"noll_{noll}") for noll in self.nolls)

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        """The modes of the table."""
        return {"nolls": sorted(int(noll) for noll in public[cls.table])} if cls.table in public else {}

    def describe(self, values: np.ndarray) -> dict[str, dict[str, float]]:
        return {self.table: {str(n): float(v) for n, v in zip(self.nolls, values, strict=True)}}

    @property
    def rms_name(self) -> str:
        """Name of the RMS of all modes together, with their unit."""
        return self.table.replace("zernike", "rms")

    def shown(self, values: np.ndarray) -> dict[str, Any]:
        return {self.rms_name: float(np.linalg.norm(values))} | self.describe(values)

    def phrase(self, public: Mapping[str, Any]) -> str:
        rms = float(np.linalg.norm(list(public[self.table].values())))
        return self.sentence.format(size=public.get(self.rms_name, rms))

    def values_of(self, *args: Any, **public: Mapping) -> list[float]:
        """See `Effect.values_of`: modes that the table lacks are 0."""
        given = {int(noll): float(value) for noll, value in public[self.table].items()}
        return [given.get(noll, 0.0) for noll in self.nolls]


class OpdMap(PupilEffect):
    """An OPD, which may depend on wavelength: multiplies the field by ``exp(2πi OPD/λ)``."""

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        return field * grid.phasor(self._map_nm(values, grid))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        turned = grid.phase_per_nm * 1j * self.apply(values, field, grid)
        return [turned * slope for slope in self._map_slopes(values, grid, wanted)]

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> Tensor | None:
        return self._map_nm(values, grid)

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        raise NotImplementedError

    def _map_slopes(self, values: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> Sequence[Tensor]:
        change = Directional(lambda v: self._map_nm(v, grid), values)
        return [change.by(index) for index in wanted]


class DiversityError(OpdMap):
    """The introduced diversity is larger than it is said to be, by some nm along its own shape.

    A lens that is not as calibrated, a mirror that does not reach its command. Not a part of the NCPAs.

    Parameters: `diversity_nm`, as introduced, Noll: nm RMS.
    """

    name = "diversity_error"
    formula = "Φ → Φ + nm · Σ d_k Z_k / |d|; d: the declared diversity, Noll k"
    mild = True
    public = (Public("nm", "nm RMS, more than introduced", -500.0, 500.0),)
    sentence = "{nm:.0f} nm more diversity"
    look_alike = "an NCPA of the same Noll index, exactly, but for a recording with another diversity"
    reference = "Gonsalves 1982, Opt. Eng. 21, 829; Blanc et al. 2003, A&A 399, 373"
    parameters = (Parameter("nm", "nm", 0.0, prior_sigma=50.0, plausible=(-150.0, 150.0)),)

    def __init__(self, diversity_nm: Mapping[int, float]):
        if not any(diversity_nm.values()):
            raise ValueError("there is no diversity that could be wrong")
        self.diversity_nm = dict(diversity_nm)

    @classmethod
    def under(cls, conditions: Conditions) -> "DiversityError":
        return cls(conditions.diversity_nm)

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: the same fraction of another diversity."""
        return _SameFraction(here.diversity_nm, self.diversity_nm)

    def imitated_in(self, recordings: Sequence[Conditions]) -> bool:
        """See `Effect.imitated_in`: unless their diversities differ."""
        return all(one.diversity_nm == recordings[0].diversity_nm for one in recordings)

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        shape = np.array(list(self.diversity_nm.values()))
        direction = shape / np.linalg.norm(shape)
        return values[0] * torch.as_tensor(np.tensordot(direction, grid.modes(list(self.diversity_nm)), 1))

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> None:
        """See `Effect.opd_nm`: nothing, as it belongs to the diversity and not to the aberrations."""


class _SameFraction(DiversityError):
    """The error in another recording; without diversity there is none.

    The diversities are those introduced in this recording and in the first one, for which the error is
    stated, by Noll index [nm RMS].
    """

    def __init__(self, diversity_nm: Mapping[int, float], first_nm: Mapping[int, float]):
        self.diversity_nm = dict(diversity_nm)
        self.first_rms_nm = float(np.linalg.norm(list(first_nm.values())))

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        total = np.zeros_like(grid.amplitude)
        for noll, nm in self.diversity_nm.items():
            total = total + nm / self.first_rms_nm * grid.modes([noll])[0]
        return values[0] * torch.as_tensor(total)


class ZernikeOpd(ZernikeTable, OpdMap):
    """An OPD by Zernike modes, whose size may depend on wavelength."""

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        return torch.tensordot(values, torch.tensor(grid.modes(self.nolls)), 1) * self._share(grid)

    def _map_slopes(self, values: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> Sequence[Tensor]:
        return [one * self._share(grid) for one in torch.tensor(grid.modes(self.nolls)[list(wanted)])]

    def _share(self, grid: PupilGrid) -> Tensor | float:
        """Of the table at the wavelengths of the `grid`."""
        return 1.0


class HighOrderNcpa(ZernikeOpd):
    """Static modes beyond the estimated ones: polishing marks of mirrors, print-through of actuators.

    The law of the NCPAs falls slowly, so modes that are left out weigh as much together as the last ones
    estimated; their light lies at the angle nλ/D of their radial order n.
    """

    name, table = "high_order_ncpa", "zernike_nm"
    formula = "Φ → Φ + Σ c_k Z_k, k beyond the modes of the model"
    aberration = True
    public = (Public(table, "Noll index: nm RMS", -1000.0, 1000.0, kind="zernike"),)
    coefficient = Parameter("", "nm", 0.0, 0.0, HIGH_ORDER_SIGMA_NM, plausible=(-200.0, 200.0))
    sentence = "{size:.0f} nm RMS of modes beyond those of the model"
    look_alike = "phase_bump and low_wind_effect, of which each mode takes a part"
    reference = "Noll 1976, JOSA 66, 207"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = ()) -> "HighOrderNcpa":
        """See `Effect.under`: by default the next two radial orders."""
        order = noll_to_nm(conditions.highest_noll + 1)[0] + EXTRA_ORDERS
        return cls(nolls or range(conditions.highest_noll + 1, order * (order + 1) // 2 + 1))


class AmplitudeAberration(ZernikeTable, PupilEffect):
    """Smooth non-uniform transmission: coatings, vignetting far from the pupil, scintillation that stays.

    The amplitude is multiplied by ``1 + Σ c_k Z_k``.
    """

    name, table = "amplitude_aberration", "zernike"
    formula = "P(u) → P(u) · (1 + Σ c_k Z_k(u))"
    mild = True
    public = (Public(table, "Noll index: relative amplitude", -1.0, 1.0, kind="zernike"),)
    coefficient = Parameter("", "", 0.0, 0.0, 0.1, -0.5, 0.5, plausible=(-0.3, 0.3))
    sentence = "a pupil whose amplitude is uneven by {size:.1%} RMS"
    look_alike = "pupil_misregistration, which has sharp edges; the halo, which is not static"
    reference = "Jolissaint et al. 2006, JOSA A 23, 382"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = range(2, 12)) -> "AmplitudeAberration":
        return cls(nolls)

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        return field * (1 + torch.tensordot(values, torch.tensor(grid.modes(self.nolls)), 1))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        return [field * mode for mode in torch.tensor(grid.modes(self.nolls)[list(wanted)])]


class NcpaDrift(ZernikeTable, TimeEffect):
    """Aberrations that change in proportion to time: temperature, flexure, a turning derotator.

    The coefficients are the change from the first frame to the last, about the mean, so the NCPAs are
    those of the middle of the recording. In the mean image a drift is a blur of second order, whose
    derivative vanishes without it; it is single frames that show it, with its sign.

    Parameters: `nolls`, among the modes that are estimated.
    """

    name, table = "ncpa_drift", "zernike_nm"
    formula = "Φ(t) = Φ + (t − ½) Σ c_k Z_k, t from 0 at the first frame to 1 at the last"
    instrumental = False
    belongs_to = "moment"
    public = (
        Public(table, "Noll index: nm RMS from the first frame to the last", -1e4, 1e4, kind="zernike"),
    )
    coefficient = Parameter("", "nm", 0.0, 0.0, 50.0, plausible=(-300.0, 300.0))
    sentence = "a drift of the wavefront of {size:.0f} nm RMS from the first frame to the last"
    look_alike = "tip_tilt_jitter and seeing_halo in the mean image; none in the frames"
    reference = "Vigan et al. 2022, A&A 660, A140"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = range(2, 12)) -> "NcpaDrift":
        return cls(nolls)

    def apply(self, values: Tensor, modes_nm: Tensor, nolls: tuple[int, ...], when: Tensor) -> Tensor:
        """See `TimeEffect.apply`.

        Raises `ValueError` if a mode that drifts is not estimated.
        """
        missing = sorted(set(self.nolls) - set(nolls))
        if missing:
            raise ValueError(f"ncpa_drift of Noll {missing}: only modes that are estimated can drift")
        where = torch.zeros(len(self.nolls), len(nolls), dtype=torch.float64)
        for row, noll in enumerate(self.nolls):
            where[row, nolls.index(noll)] = 1
        return modes_nm + (when.double() - 0.5)[:, None] * (values @ where)


class _Table(ZernikeOpd):
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


class ChromaticNcpa(_Table):
    """Aberrations in proportion to wavelength: lenses, windows and prisms of glass.

    The NCPAs are those at the reference wavelength, and each mode changes by its slope per µm from there.
    In a narrow band the slope is a part of the NCPAs.

    Parameters: `reference_nm`, wavelength at which it vanishes; `law`, of the prior, per µm.
    """

    name, table, default = "chromatic_ncpa", "zernike_nm_per_um", CHROMATIC_NOLLS
    formula = "Φ(λ) = Φ + (λ − λ_ref) Σ c_k Z_k, λ_ref = reference_nm"
    aberration = True
    public = (Public(table, "Noll index: nm RMS per µm", -2000.0, 2000.0, kind="zernike"),)
    options = (
        NOLLS,
        Public("reference_nm", "nm, where it vanishes; that of the NCPAs if left out", 300.0, 5000.0),
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
    ) -> "ChromaticNcpa":
        return cls(nolls or cls.default, reference_nm or conditions.reference_nm, conditions.ncpa_law)

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        reach = [nm for one in recordings for nm, _ in one.settings.spectrum]
        return max(reach) - min(reach) > BROAD_NM

    def _share(self, grid: PupilGrid) -> Tensor:
        return (grid.wavelengths_m - self.reference_nm * 1e-9) / UM

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> None:
        """See `Effect.opd_nm`: nothing, at the wavelength of the NCPAs."""


class FilterNcpa(_Table):
    """The wavefront of one filter or lens, against that of recordings without it.

    It acts in recordings through every one of some `elements`: names of filters and of sources of diversity.

    Parameters: `law`, of the prior.
    """

    name, table, default = "filter_ncpa", "zernike_nm", FILTER_NOLLS
    formula = "Φ → Φ + Σ c_k Z_k in recordings through the filter or lens"
    aberration = True
    repeatable = True
    public = (Public(table, "Noll index: nm RMS", -2000.0, 2000.0, kind="zernike"),)
    options = (
        NOLLS,
        Public("of", "filter or source of diversity; both of the recording if left out", kind="word"),
    )
    coefficient = Parameter("", "nm", 0.0, 0.0, WITHOUT_LAW_NM, plausible=(-300.0, 300.0))
    sentence = "a wavefront of the filter or lens of {size:.0f} nm RMS"
    look_alike = "an NCPA, exactly, but for a recording through another filter or lens"
    reference = "Paxman, Schulz & Fienup 1992, J. Opt. Soc. Am. A 9, 1072: joint fits of several recordings"

    def __init__(self, nolls: Sequence[int], elements: Sequence[str], law: NcpaLaw | None = None):
        super().__init__(nolls, law)
        self.elements, self.law = frozenset(elements), law

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = (), of: str = "") -> "FilterNcpa":
        elements = (of,) if of else conditions.elements
        return cls(nolls or cls.default, elements, conditions.ncpa_law)

    @property
    def of(self) -> str:
        """The filter or source of diversity that it belongs to; empty where these are several."""
        return next(iter(self.elements)) if len(self.elements) == 1 else ""

    def with_focus(self) -> "FilterNcpa":
        """Return the same with Noll 4, which recordings of known focus show; chosen modes stay."""
        if self.nolls != tuple(self.default):
            return self
        return FilterNcpa((4, *self.nolls), tuple(self.elements), self.law)

    def lies_in(self, conditions: Conditions) -> bool:
        """Whether the light of a recording taken under `conditions` passes the elements."""
        return self.elements <= set(conditions.elements)

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        return len({self.lies_in(one) for one in recordings}) == 2

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        return self if self.lies_in(here) else _Absent(self)

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        return FixedEffect(self.seen_in(now, now), values)


class _Absent(FilterNcpa):
    """The wavefront of a filter or lens in a recording without it."""

    def __init__(self, effect: FilterNcpa):
        self.nolls, self.elements, self.parameters = effect.nolls, effect.elements, effect.parameters

    def _share(self, grid: PupilGrid) -> float:
        return 0.0
