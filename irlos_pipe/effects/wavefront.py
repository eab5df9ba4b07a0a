"""Static changes of the field: `diversity_error`, `high_order_ncpa`, `amplitude_aberration`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, number
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.effects.zernike_table import ZernikeTable
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.zernike import noll_to_nm

HIGH_ORDER_SIGMA_NM = 60.0
EXTRA_ORDERS = 2  # radial orders beyond the estimated modes, by default


class OpdMap(PupilEffect):
    """An OPD, which may depend on wavelength: multiplies the field by ``exp(2πi OPD/λ)``."""

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        return field * grid.phasor(self._map_nm(values, grid))

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        turned = grid.phase_per_nm * 1j * self.apply(values, field, grid)
        return [turned * slope for slope in self._map_slopes(values, grid, wanted)]

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor | None:
        """See `PupilEffect.opd_nm`."""
        return self._map_nm(values, grid)

    def _map_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        raise NotImplementedError

    def _map_slopes(
        self, values: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        change = Directional(lambda v: self._map_nm(v, grid), values)
        return [change.by(index) for index in wanted]


class DiversityError(OpdMap):
    """The introduced diversity is larger than it is said to be, by some nm along its own shape.

    A lens that is not as calibrated, a mirror that does not reach its command. Not a part of the NCPAs.

    Parameters
    ----------
    diversity_nm : mapping of int to float
        As introduced, Noll: nm RMS.
    """

    name = "diversity_error"
    formula = "Φ → Φ + nm · Σ d_k Z_k / |d|; d: the diversity as told, Noll k"
    mild = True
    public = (number("nm", "nm RMS, more than introduced", -500.0, 500.0),)
    sentence = "{nm:.0f} nm more diversity"
    look_alike = "an NCPA of the same Noll index, exactly, but for a recording with another diversity"
    reference = "Gonsalves 1982, Opt. Eng. 21, 829; Blanc et al. 2003, A&A 399, 373"
    parameters = (Parameter("nm", "nm", 0.0, prior_sigma=50.0, plausible=(-150.0, 150.0)),)

    def __init__(self, diversity_nm: Mapping[int, float]):
        if not any(diversity_nm.values()):
            raise ValueError("there is no diversity that could be wrong")
        self.diversity_nm = dict(diversity_nm)

    @classmethod
    def under(cls, conditions: Conditions) -> DiversityError:
        """See `Effect.under`."""
        return cls(conditions.diversity_nm)

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: the same fraction of another diversity."""
        return _SameFraction(here.diversity_nm, self.diversity_nm)

    def imitated_in(self, recordings: Sequence[Conditions]) -> bool:
        """See `Effect.imitated_in`: unless their diversities differ."""
        return all(one.diversity_nm == recordings[0].diversity_nm for one in recordings)

    def _map_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        shape = np.array(list(self.diversity_nm.values()))
        direction = shape / np.linalg.norm(shape)
        return values[0] * torch.as_tensor(np.tensordot(direction, grid.modes(list(self.diversity_nm)), 1))

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> None:
        """See `Effect.opd_nm`: nothing, as it belongs to the diversity and not to the aberrations."""


class _SameFraction(DiversityError):
    """The error in another recording; without diversity there is none.

    Parameters
    ----------
    diversity_nm, first_nm : mapping of int to float
        As introduced in this recording, and in the one for which the error is stated, Noll: nm RMS.
    """

    def __init__(self, diversity_nm: Mapping[int, float], first_nm: Mapping[int, float]):
        self.diversity_nm = dict(diversity_nm)
        self.first_rms_nm = float(np.linalg.norm(list(first_nm.values())))

    def _map_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        total = np.zeros_like(grid.amplitude)
        for noll, nm in self.diversity_nm.items():
            total = total + nm / self.first_rms_nm * grid.modes([noll])[0]
        return values[0] * torch.as_tensor(total)


class HighOrderNcpa(ZernikeTable, OpdMap):
    """Static modes beyond the estimated ones: polishing marks of mirrors, print-through of actuators.

    The law of the NCPAs falls slowly, so modes that are left out weigh as much together as the last ones
    estimated; their light lies at the angle nλ/D of their radial order n.

    Parameters
    ----------
    nolls : sequence of int
    """

    name, table = "high_order_ncpa", "zernike_nm"
    formula = "Φ → Φ + Σ c_k Z_k, k beyond the modes of the model"
    aberration = True
    public = (Public(table, "Noll index: nm RMS", "zernike", -1000.0, 1000.0),)
    options = (Public("nolls", "Noll indices to estimate", "nolls"),)
    coefficient = Parameter("", "nm", 0.0, 0.0, HIGH_ORDER_SIGMA_NM, plausible=(-200.0, 200.0))
    sentence = "{size:.0f} nm RMS of modes beyond those of the model"
    look_alike = "phase_bump and low_wind_effect, of which each mode takes a part"
    reference = "Noll 1976, JOSA 66, 207"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = ()) -> HighOrderNcpa:
        """See `Effect.under`: by default the next two radial orders."""
        order = noll_to_nm(conditions.highest_noll + 1)[0] + EXTRA_ORDERS
        return cls(nolls or range(conditions.highest_noll + 1, order * (order + 1) // 2 + 1))

    def _map_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        return torch.tensordot(values, torch.tensor(grid.modes(self.nolls)), 1)

    def _map_slopes(
        self, values: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        return torch.tensor(grid.modes(self.nolls)[list(wanted)]).unbind()


class AmplitudeAberration(ZernikeTable, PupilEffect):
    """Smooth non-uniform transmission: coatings, vignetting far from the pupil, scintillation that stays.

    The amplitude is multiplied by ``1 + Σ c_k Z_k``.

    Parameters
    ----------
    nolls : sequence of int
    """

    name, table = "amplitude_aberration", "zernike"
    formula = "P(u) → P(u) · (1 + Σ c_k Z_k(u))"
    mild = True
    public = (Public(table, "Noll index: relative amplitude", "zernike", -1.0, 1.0),)
    options = (Public("nolls", "Noll indices to estimate", "nolls"),)
    coefficient = Parameter("", "", 0.0, 0.0, 0.1, -0.5, 0.5, plausible=(-0.3, 0.3))
    sentence = "a pupil whose amplitude is uneven by {size:.1%} RMS"
    look_alike = "pupil_misregistration, which has sharp edges; the halo, which is not static"
    reference = "Jolissaint et al. 2006, JOSA A 23, 382"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = range(2, 12)) -> AmplitudeAberration:
        """See `Effect.under`: by default the modes up to spherical, Noll 2 to 11."""
        return cls(nolls)

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        return field * (1 + torch.tensordot(values, torch.tensor(grid.modes(self.nolls)), 1))

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        return [field * mode for mode in torch.tensor(grid.modes(self.nolls)[list(wanted)])]
