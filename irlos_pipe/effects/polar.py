"""Size and direction of something with two components, as results state it."""

from __future__ import annotations

import numpy as np


def size_and_angle(x: float, y: float) -> tuple[float, float]:
    """Size, and direction from +x towards +y in [0, 360) [deg]."""
    return float(np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)) % 360)


def components(size: float, angle_deg: float) -> list[float]:
    """The components x and y again."""
    angle = np.deg2rad(angle_deg)
    return [float(size * np.cos(angle)), float(size * np.sin(angle))]
