"""Where a drawn part lies: mirrored, turned and moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Flip = Literal["none", "x", "y"]


@dataclass(frozen=True)
class Placement:
    """Mirrored up and down (or not), then turned anticlockwise about the axis, then moved.

    Attributes
    ----------
    rotation_deg : float
    mirrored : bool
        Whether y changes its sign first.
    shift_m : (float, float)
    """

    rotation_deg: float = 0.0
    mirrored: bool = False
    shift_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, rotation_deg: float, flip: Flip, shift_m: tuple[float, float]) -> Placement:
        """Return a placement whose `flip` exchanges left and right ("x"), up and down ("y") or nothing.

        `rotation_deg` and `shift_m` are as of the class.
        """
        # x changing its sign is y doing so and half a turn
        return cls(rotation_deg + 180.0 * (flip == "x"), flip != "none", shift_m)

    def then(self, outer: Placement) -> Placement:
        """Return the placement `outer` of what is placed by this one."""
        sense = -1 if outer.mirrored else 1
        x, y = outer.forth(*self.shift_m)
        return Placement(
            outer.rotation_deg + sense * self.rotation_deg,
            self.mirrored != outer.mirrored,
            (float(x), float(y)),
        )

    def forth(self, x_m, y_m):
        """Return where points (`x_m`, `y_m`) of the part as drawn come to lie."""
        if self == UNMOVED:
            return x_m, y_m
        cos, sin = self._cos_sin
        y_m = -y_m if self.mirrored else y_m
        return cos * x_m - sin * y_m + self.shift_m[0], sin * x_m + cos * y_m + self.shift_m[1]

    def back(self, x_m, y_m):
        """Return where points (`x_m`, `y_m`) of the placed part lie on the part as drawn."""
        if self == UNMOVED:
            return x_m, y_m
        cos, sin = self._cos_sin
        x_m, y_m = x_m - self.shift_m[0], y_m - self.shift_m[1]
        x_m, y_m = cos * x_m + sin * y_m, cos * y_m - sin * x_m
        return x_m, (-y_m if self.mirrored else y_m)

    @property
    def _cos_sin(self) -> tuple[float, float]:
        turn = np.deg2rad(self.rotation_deg)
        return float(np.cos(turn)), float(np.sin(turn))


UNMOVED = Placement()
