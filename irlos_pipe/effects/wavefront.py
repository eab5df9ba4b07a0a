"""Static wavefront beyond the estimated modes: `diversity_error`, `high_order_ncpa` and `phase_bump`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, number
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.effects.zernike_table import ZernikeTable
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.zernike import noll_to_nm

HIGH_ORDER_SIGMA_NM = 60.0
EXTRA_ORDERS = 2  # radial orders beyond the estimated modes, by default
REACH_M = 4.0  # from the axis
BUMP_STEP_M, BUMP_WIDTHS_M = 0.8, (0.3, 0.8)  # of a search


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


class PhaseBump(OpdMap):
    """A Gaussian OPD somewhere in the pupil: a bad actuator, glue, dust on a mirror near the pupil.

    ``nm · exp(-½ r²/width²)``. Position and width mean nothing without it and are scanned in a search.

    Parameters
    ----------
    start : (float, float, float, float)
        Height [nm], x, y and width [m].
    """

    name = "phase_bump"
    formula = "Φ → Φ + nm · exp(−½ |u − (x_m, y_m)|² / width_m²)"
    repeatable = True
    aberration = True
    public = (
        number("nm", "nm, peak", -2000.0, 2000.0),
        number("x_m", "m", -5.0, 5.0, role="position"),
        number("y_m", "m", -5.0, 5.0, role="position"),
        number("width_m", "m, sigma", 0.01, 5.0, role="position"),
    )
    sentence = "a bump of {nm:.0f} nm at ({x_m:.1f}, {y_m:.1f}) m in the pupil, {width_m:.1f} m wide"
    look_alike = "high_order_ncpa, of which every mode takes a part of the bump"
    reference = "MUSE-NFM phase bump, 206 nm RMS in all"

    def __init__(self, start: tuple[float, float, float, float] = (50.0, 2.0, 0.0, 0.5)):
        height, x, y, width = start
        self.parameters = (
            Parameter("nm", "nm", height, 0.0, 300.0, plausible=(-1000.0, 1000.0)),
            Parameter("x_m", "m", x, lower=-REACH_M, upper=REACH_M, null=None),
            Parameter("y_m", "m", y, lower=-REACH_M, upper=REACH_M, null=None),
            Parameter("width_m", "m", width, 0.6, 0.6, 0.1, 3.0, None, (0.15, 2.0)),
        )

    def _map_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        return values[0] * self._unit(values, grid)[0]

    def _map_slopes(
        self, values: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        bump, x, y = self._unit(values, grid)
        per_m = values[0] / values[3] * bump
        slopes = [bump, per_m * x, per_m * y, per_m * (x**2 + y**2)]
        return [slopes[index] for index in wanted]

    def _unit(self, values: torch.Tensor, grid: PupilGrid) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The bump of height 1, and the places in the pupil from its centre, in widths."""
        _, x, y, width = values
        u, v = (torch.as_tensor(axis * grid.radius_m) for axis in grid.xy)
        u, v = (u - x) / width, (v - y) / width
        return torch.exp(-(u**2 + v**2) / 2) * torch.tensor(grid.lit), u, v

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        """See `Effect.candidates`: one per position on a grid and per width."""
        steps = np.arange(-REACH_M + BUMP_STEP_M / 2, REACH_M, BUMP_STEP_M)
        return [
            FixedEffect(self, [0.0, x, y, width], free=("nm",))
            for width in BUMP_WIDTHS_M
            for y in steps
            for x in steps
            if np.hypot(x, y) < REACH_M
        ]
