"""One place in the pupil that differs from all others: `phase_bump` and `pupil_spot`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.effects.base import Effect, FixedEffect, Values
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.effects.wavefront import OpdMap
from irlos_pipe.optics.grids import PupilGrid

STEP, WIDTHS = 0.1, (0.0375, 0.1)  # of the grid of a search, in diameters of the pupil
STEEPNESS = float(np.log(2))  # of the edge of a spot, which is half as dark at its radius


class PupilPlace(PupilEffect):
    """Something of some height at one place in the pupil, round and with a soft edge.

    Position and width mean nothing without it and are scanned in a search. The place lies within the pupil of
    `diameter_m`, whose hole lets no light pass, and no width is larger than that.
    """

    repeatable = True
    height: ClassVar[Parameter]
    width: ClassVar[Parameter]  # in diameters of the pupil

    def __init__(self, diameter_m: float = 8.0, hole_m: float = 0.0):
        rim = diameter_m / 2
        self.diameter_m, self.hole_m = diameter_m, hole_m
        self.parameters = (
            self.height,
            Parameter("x_m", "m", rim / 2, lower=-rim, upper=rim, null=None),
            Parameter("y_m", "m", 0.0, lower=-rim, upper=rim, null=None),
            _scaled(self.width, diameter_m),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> Self:
        geometry = conditions.settings.geometry
        return cls(geometry.diameter_m, geometry.obscuration_m)

    def lit(self, values: Values) -> bool:
        """Whether light passes the place."""
        return self.hole_m <= 2 * np.hypot(float(values[1]), float(values[2])) <= self.diameter_m

    def unusual(self, values: Values) -> list[str]:
        return [*super().unusual(values), *([] if self.lit(values) else ["x_m", "y_m"])]

    def profile(self, square: Tensor) -> tuple[Tensor, Tensor]:
        """What is at a `square` of the distance in widths, of height 1, and its derivative, (n, n) each."""
        raise NotImplementedError

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        steps = np.arange(-0.5 + STEP / 2, 0.5, STEP)
        places = [(x, y, width) for width in WIDTHS for y in steps for x in steps if np.hypot(x, y) < 0.5]
        return [
            FixedEffect(self, [0.0, *(self.diameter_m * one for one in place)], free=(self.height.name,))
            for place in places
        ]

    def _map(self, values: Tensor, grid: PupilGrid) -> Tensor:
        """What is added, (n, n)."""
        u, v = self._places(values, grid)
        return values[0] * self.profile(u**2 + v**2)[0] * torch.tensor(grid.lit)

    def _map_slopes(self, values: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> Sequence[Tensor]:
        """Its derivatives with respect to the parameters `wanted`, (n, n) each."""
        u, v = self._places(values, grid)
        square, lit = u**2 + v**2, torch.tensor(grid.lit)
        unit, change = (one * lit for one in self.profile(square))
        inwards = -2 * values[0] / values[3] * change
        slopes = [unit, inwards * u, inwards * v, inwards * square]
        return [slopes[index] for index in wanted]

    def _places(self, values: Tensor, grid: PupilGrid) -> tuple[Tensor, Tensor]:
        """Places in the pupil from the centre, in widths; they combine to (n, n)."""
        _, x, y, width = values
        u, v = (torch.as_tensor(axis * grid.radius_m) for axis in grid.xy)
        return (u - x) / width, (v - y) / width


class PhaseBump(PupilPlace, OpdMap):
    """A Gaussian OPD somewhere in the pupil: a bad actuator, glue, dust on a mirror near the pupil.

    ``nm · exp(-½ r²/width²)``. Position and width mean nothing without it and are scanned in a search.
    """

    name = "phase_bump"
    formula = "Φ → Φ + nm · exp(−½ |u − (x_m, y_m)|² / width_m²)"
    aberration = True
    height = Parameter("nm", "nm", 50.0, 0.0, 300.0, plausible=(-1000.0, 1000.0))
    width = Parameter("width_m", "m", 0.0625, 0.075, 0.075, 0.0125, 0.375, None, (0.019, 0.25))
    public = (
        Public("nm", "nm, peak", -2000.0, 2000.0),
        Public("x_m", "m", -20.0, 20.0, role="position"),
        Public("y_m", "m", -20.0, 20.0, role="position"),
        Public("width_m", "m, sigma", 0.01, 20.0, role="position"),
    )
    sentence = "a bump of {nm:.0f} nm at ({x_m:.1f}, {y_m:.1f}) m in the pupil, {width_m:.1f} m wide"
    look_alike = "high_order_ncpa, of which every mode takes a part of the bump; pupil_spot in a narrow band"
    reference = "MUSE-NFM phase bump, 206 nm RMS in all"

    def profile(self, square: Tensor) -> tuple[Tensor, Tensor]:
        bump = torch.exp(-square / 2)
        return bump, -bump / 2

    def _map_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        return self._map(values, grid)


class PupilSpot(PupilPlace):
    """A dark spot somewhere in the pupil: dirt near the pupil, a screw of a stop, a masked actuator.

    The amplitude is multiplied by ``1 - opacity · exp(-ln 2 · (r/radius)⁴)``, a disc with a soft edge. Of a
    small one the image shows the area that is dark, and hardly more.
    """

    name = "pupil_spot"
    formula = "P(u) → P(u) · (1 − opacity · exp(−ln 2 · |u − (x_m, y_m)|⁴ / radius_m⁴))"
    height = Parameter("opacity", "", 0.5, 0.0, 1.0, 0.0, 1.0, natural=True)
    width = Parameter("radius_m", "m", 0.05, 0.05, 0.05, 0.00625, 0.25, None)
    public = (
        Public("opacity", "part of the amplitude", 0.0, 1.0),
        Public("x_m", "m", -20.0, 20.0, role="position"),
        Public("y_m", "m", -20.0, 20.0, role="position"),
        Public("radius_m", "m, where it is half as dark", 0.01, 20.0, role="position"),
    )
    sentence = (
        "a spot in the pupil at ({x_m:.1f}, {y_m:.1f}) m, {radius_m:.2f} m in radius, that stops "
        "{opacity:.0%} of the amplitude"
    )
    look_alike = "phase_bump of a wave or more in a narrow band; amplitude_aberration, which is smooth"
    reference = "Goodman 2005, Introduction to Fourier Optics, 3rd ed., Sect. 3.10"

    def profile(self, square: Tensor) -> tuple[Tensor, Tensor]:
        disc = torch.exp(-STEEPNESS * square**2)
        return disc, -2 * STEEPNESS * square * disc

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        return field * (1 - self._map(values, grid))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        return [-field * slope for slope in self._map_slopes(values, grid, wanted)]


def _scaled(width: Parameter, diameter_m: float) -> Parameter:
    """A width stated in diameters, in metres."""
    names = ("start", "prior_mean", "prior_sigma", "lower", "upper")
    metres = {name: diameter_m * getattr(width, name) for name in names}
    low, high = width.plausible
    return replace(width, plausible=(diameter_m * low, diameter_m * high), **metres)
