"""Where light passes the pupil, and how much: `pupil_misregistration` and `amplitude_aberration`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.pupil_drawing import turned
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, number
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.effects.redrawn_pupil import Drawing, RedrawnPupil
from irlos_pipe.effects.zernike_table import ZernikeTable
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil_edges import Edges

DIRECTIONS = 8


class PupilMisregistration(RedrawnPupil):
    """An internal stop that does not lie on the image of the telescope pupil, and vanes that are turned.

    The stop has the outline and the central hole of the pupil, but no vanes or gaps between segments; light
    passes where both do. Of a disc, the vanes and other obstructions are turned; of a segmented pupil or a
    map, all of it.

    Any shift darkens a crescent at the rim and one at the hole, whichever way it goes: the image is not
    differentiable in (dx, dy) at zero, but it is in (distance ≥ 0, direction).

    Parameters
    ----------
    start : (float, float, float)
        Distance [m], direction and rotation [deg].
    """

    name = "pupil_misregistration"
    formula = (
        "P(u) → P(u; vanes turned by rotation_deg) · S(u − (dx_m, dy_m)); S: stop with outline and hole of P"
    )
    fact = varies = True
    public = (
        number("dx_m", "m", -1.0, 1.0, role="component"),
        number("dy_m", "m", -1.0, 1.0, role="component"),
        number("rotation_deg", "deg of the vanes, anticlockwise", -180.0, 180.0),
    )
    look_alike = "amplitude_aberration of Noll 2 and 3, which has no sharp edges"
    reference = "Dohlen et al. 2006, SPIE 6269, 62690Q; VLT pupil stops"

    def __init__(self, start: tuple[float, float, float] = (0.03, 0.0, 0.0)):
        distance, direction, rotation = start
        self.parameters = (
            Parameter("distance_m", "m", distance, 0.0, 0.3, 0.0, 1.0, plausible=(0.0, 0.5)),
            Parameter("direction_rad", "rad", np.deg2rad(direction), null=None),
            Parameter("rotation_deg", "deg", rotation, 0.0, 5.0, -45.0, 45.0, plausible=(-15.0, 15.0)),
        )

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        """See `RedrawnPupil.redrawn`."""
        distance_m, direction_rad, rotation_deg = values
        stop_m = (float(distance_m * np.cos(direction_rad)), float(distance_m * np.sin(direction_rad)))
        turned_deg = drawing.turned_deg + rotation_deg
        return Drawing(turned(drawing.geometry, rotation_deg), stop_m, turned_deg)

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        """See `RedrawnPupil.edge_slope`."""
        distance_m, direction_rad, _ = values
        if index == 2:
            return edges.turned() * np.pi / 180
        towards = np.array([np.cos(direction_rad), np.sin(direction_rad)])
        velocity = towards if index == 0 else distance_m * np.array([-towards[1], towards[0]])
        return edges.moved((float(velocity[0]), float(velocity[1])))

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Displacement of the stop and rotation of the vanes."""
        distance, direction, rotation = (float(v) for v in values)
        return {
            "dx_m": distance * float(np.cos(direction)),
            "dy_m": distance * float(np.sin(direction)),
            "rotation_deg": rotation,
        }

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: what rounds to nothing is left out."""
        x, y, turn = (public[key] for key in ("dx_m", "dy_m", "rotation_deg"))
        turned = f"vanes turned by {turn:+.1f}° against the profile" if round(turn, 1) else ""
        moved = f"a stop {x:+.3f}, {y:+.3f} m off" if round(x, 3) or round(y, 3) else ""
        return " and ".join(filter(None, [turned, moved])) or "an internal stop in its place"

    def values_of(self, dx_m: float, dy_m: float, rotation_deg: float) -> list[float]:
        """See `Effect.values_of`."""
        return [float(np.hypot(dx_m, dy_m)), float(np.arctan2(dy_m, dx_m)), rotation_deg]

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        """See `Effect.candidates`: one per direction of the shift, and the rotation."""
        angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
        shifts = [FixedEffect(self, [0.0, angle, 0.0], free=("distance_m",)) for angle in angles]
        return [*shifts, FixedEffect(self, [0.0, 0.0, 0.0], free=("rotation_deg",))]


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
