"""A deformable mirror of Gaussian influence functions that is sent modal offsets.

The control computer turns offsets of Zernike modes into the strokes that come nearest to them over the pupil,
for the mirror as it is believed to be. What the mirror then does differs by its gain and by where it lies:
its actuators may be shifted and turned against the pupil.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.telescope import Telescope, zernike

POINTS_PER_PITCH, FEWEST_POINTS = 3, 64  # at which strokes are fitted: per actuator, and across
DAMPING = 1e-6  # regularisation of the strokes, relative to the mean response of an actuator


@dataclass(frozen=True)
class Actuators:
    """A square grid of actuators, `pitch_m` apart, under a pupil of `diameter_m`; it ends a pitch beyond it.

    `coupling` is the height of an influence function at the next actuator, of 1 at its own.
    """

    diameter_m: float
    pitch_m: float
    coupling: float = 0.3

    @property
    def positions_m(self) -> np.ndarray:
        """Return the places of rows and columns, symmetric about the axis, (places,) [m]."""
        half = int(np.ceil(self.diameter_m / 2 / self.pitch_m)) + 1
        return (np.arange(2 * half) - half + 0.5) * self.pitch_m

    @property
    def present(self) -> np.ndarray:
        """Return where there is an actuator, (places, places); row index is y."""
        x_m, y_m = np.meshgrid(self.positions_m, self.positions_m)
        return np.hypot(x_m, y_m) <= self.diameter_m / 2 + self.pitch_m

    def along(self, at_m: np.ndarray) -> np.ndarray:
        """Return the influence of every place at coordinates `at_m`, (points,): (points, places)."""
        distance = (at_m[:, None] - self.positions_m) / self.pitch_m
        return self.coupling ** (distance**2)


@dataclass(frozen=True)
class Mirror:
    """A mirror and what it has been sent: modal offsets, Noll 2 to 30 [nm RMS]."""

    actuators: Actuators
    gain: float = 1.0  # stroke over the stroke that was asked for
    shift_m: tuple[float, float] = (0.0, 0.0)  # by which the actuators lie off the pupil, (x, y)
    turn_deg: float = 0.0  # by which they are turned about the axis, anticlockwise, before they are shifted
    offsets_nm: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = sorted(set(self.offsets_nm) - set(REPORTED_NOLLS))
        if unknown:
            raise SceneError(f"mirror: there are no offsets of Noll {', '.join(map(str, unknown))}")

    def opd_nm(self, telescope: Telescope) -> np.ndarray:
        """Return the wavefront that the mirror makes on the grid of `telescope`, (n, n) [nm]."""
        strokes = modal_strokes(self.actuators)
        total_nm = sum(
            (value_nm * strokes[noll - REPORTED_NOLLS[0]] for noll, value_nm in self.offsets_nm.items()),
            np.zeros_like(strokes[0]),
        )
        # points of the pupil in the coordinates of the actuators
        x_m, y_m = telescope.u_m[None, :] - self.shift_m[0], telescope.u_m[:, None] - self.shift_m[1]
        cosine, sine = np.cos(np.deg2rad(self.turn_deg)), np.sin(np.deg2rad(self.turn_deg))
        along_x = self.actuators.along((cosine * x_m + sine * y_m).ravel())
        along_y = self.actuators.along((cosine * y_m - sine * x_m).ravel())
        shape_nm = np.einsum("px,px->p", along_y @ total_nm, along_x)
        return self.gain * shape_nm.reshape(telescope.transmission.shape)


@cache
def modal_strokes(actuators: Actuators) -> np.ndarray:
    """Return the strokes of `actuators` that come nearest to Noll 2..30 of 1 nm RMS over the pupil's disc.

    (29, places, places) [nm]: rows are y, columns x; zero where there is no actuator.
    """
    radius_m = actuators.diameter_m / 2
    points = max(FEWEST_POINTS, int(np.ceil(POINTS_PER_PITCH * actuators.diameter_m / actuators.pitch_m)))
    unit = (np.arange(points) + 0.5) * 2 / points - 1
    x, y = (one.ravel() for one in np.meshgrid(unit, unit))
    inside = np.hypot(x, y) <= 1
    x, y = x[inside], y[inside]
    present = actuators.present
    rows, columns = np.nonzero(present)
    influence = actuators.along(y * radius_m)[:, rows] * actuators.along(x * radius_m)[:, columns]
    normal = influence.T @ influence
    normal[np.diag_indices_from(normal)] += DAMPING * np.trace(normal) / len(normal)
    modes = np.array([zernike(noll, x, y) for noll in REPORTED_NOLLS])
    strokes = np.zeros((len(REPORTED_NOLLS), *present.shape))
    strokes[:, present] = np.linalg.solve(normal, influence.T @ modes.T).T
    return strokes
