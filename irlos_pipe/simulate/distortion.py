"""Pixels that look at an image through a linear distortion: splines through a finer image, point by point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from irlos_pipe.simulate.imaging import PixelGrid

SPLINE = 5  # order: errs by less than 1e-5 of the peak where a sample holds less than 0.2 cycles
EDGE_PX = 8  # beyond which a spline does not see where the image ends


def stretch(fraction: float, angle_deg: float) -> np.ndarray:
    """Return the matrix by which an image is larger along a direction than across, in (x, y), (2, 2).

    Parameters
    ----------
    fraction : float
        Difference of the scales along and across, over their mean. Areas stay.
    angle_deg : float
        Of the larger scale, from +x towards +y.
    """
    along = np.sqrt((1 + fraction / 2) / (1 - fraction / 2))
    angle = np.deg2rad(angle_deg)
    direction = np.array([np.cos(angle), np.sin(angle)])
    projection = np.outer(direction, direction)
    return along * projection + (np.eye(2) - projection) / along


@dataclass(frozen=True)
class Distortion:
    """Pixels of a window on a distorted image.

    Attributes
    ----------
    stretch : ndarray, (2, 2)
        Of the image about the optical axis, in (x, y).
    pixels : PixelGrid
    """

    stretch: np.ndarray
    pixels: PixelGrid

    @property
    def reach_px(self) -> int:
        """Return how far beyond the window pixels may look [px]."""
        farthest = np.abs(np.linalg.inv(self.stretch) - np.eye(2)).sum(axis=1).max()
        return int(np.ceil(farthest * max(self.pixels.window) / 2)) + EDGE_PX

    def seen(self, samples: np.ndarray, step_mas: float) -> np.ndarray:
        """Return the light in every pixel, (rows, columns).

        Parameters
        ----------
        samples : ndarray, (m, n)
            Of the undistorted image about the optical axis, each times the square of their distance.
        step_mas : float
            That distance.
        """
        y_mas, x_mas = self.pixels.node_angles_mas()
        nodes = np.stack(np.meshgrid(x_mas, y_mas)).reshape(2, -1)
        x, y = np.linalg.solve(self.stretch, nodes) / step_mas
        middle = (np.array(samples.shape) - 1) / 2
        places = np.stack([y + middle[0], x + middle[1]])
        light = ndimage.map_coordinates(samples, places, order=SPLINE, mode="mirror") / step_mas**2
        light = light / abs(np.linalg.det(self.stretch))
        return self.pixels.integrated(light.reshape(1, len(y_mas), len(x_mas)))[0]
