"""Effects that the catalogue does not have: what the suite itself does to pupil, light or pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.signal import fftconvolve

from irlos_pipe.conventions.pupil_drawing import Vane
from irlos_pipe.simulate.aperture import centres

Image = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Foreign:
    """One such effect: its drawn numbers, and what it does."""

    truth: Mapping[str, Any] = field(default_factory=dict)
    image: Image = np.asarray  # mean photo-electrons (rows, columns) with the effect, from those without
    patches: tuple[Vane, ...] = ()  # opaque rectangles added to the pupil


def scratch(rng: np.random.Generator) -> Foreign:
    """A hair or a scratch: an opaque line across a part of the pupil."""
    width, length, turn = rng.uniform(0.05, 0.15), rng.uniform(2.5, 4.5), rng.uniform(0, 2 * np.pi)
    radius, angle = rng.uniform(1.5, 2.5), rng.uniform(0, 2 * np.pi)
    middle = radius * np.array([np.cos(angle), np.sin(angle)])
    half = length / 2 * np.array([np.cos(turn), np.sin(turn)])
    ends = [tuple(float(one) for one in middle + side * half) for side in (-1, 1)]
    truth = {"width_m": float(width), "from_m": ends[0], "to_m": ends[1]}
    return Foreign(truth, patches=(Vane(*ends, float(width)),))


def keystone(rng: np.random.Generator) -> Foreign:
    """The image of a tilted plane: its scale changes along one direction, by 5 to 12 % across the window."""
    change, angle = float(rng.uniform(0.05, 0.12)), float(rng.uniform(0, 2 * np.pi))
    towards = np.array([np.sin(angle), np.cos(angle)])  # (y, x)
    truth = {"fraction": change, "angle_deg": np.rad2deg(angle)}
    return Foreign(truth, lambda image: seen_aslant(image, change * towards / max(image.shape)))


def unsteady_rows(rng: np.random.Generator) -> Foreign:
    """Every row is displaced along the columns by its own part of a pixel: an unsteady clock."""
    rms_px = float(rng.uniform(0.05, 0.2))
    shifts_px = rms_px * rng.standard_normal(64)
    return Foreign({"rms_px": rms_px}, lambda image: displaced_rows(image, shifts_px[: len(image)]))


def scattered_light(rng: np.random.Generator) -> Foreign:
    """Rough or dusty optics: a wide skirt without speckles, ``(1 + (r/a)²)^(-3/2)``."""
    part, core_px = float(rng.uniform(0.04, 0.12)), float(rng.uniform(4, 10))
    y, x = np.mgrid[-31:32, -31:32]
    kernel = (1 + (x**2 + y**2) / core_px**2) ** -1.5
    kernel *= part / kernel.sum()

    def image(image_e: np.ndarray) -> np.ndarray:
        return (1 - part) * image_e + fftconvolve(image_e, kernel, mode="same")

    return Foreign({"fraction": part, "core_px": core_px}, image)


def electronic_ghost_row(rng: np.random.Generator) -> Foreign:
    """Every row is lifted by a part of the charge that is read with it."""
    part = float(rng.uniform(0.02, 0.06))
    return Foreign({"fraction": part}, lambda image: image + part * image.mean(axis=1, keepdims=True))


def charge_trail(rng: np.random.Generator) -> Foreign:
    """Slow pixels: a part of the charge is read with the next columns, less and less."""
    part, length_px = float(rng.uniform(0.01, 0.04)), float(rng.uniform(1.0, 4.0))
    tail = np.exp(-np.arange(1, 16) / length_px)
    kernel = np.concatenate([np.zeros(15), [1 - part], part * tail / tail.sum()])
    return Foreign(
        {"fraction": part, "length_px": length_px},
        lambda image: ndimage.convolve1d(image, kernel, axis=1, mode="nearest"),
    )


def flat_field_error(rng: np.random.Generator) -> Foreign:
    """The gain of every pixel differs from the flat's."""
    rms = float(rng.uniform(0.01, 0.03))
    gain = 1 + rms * rng.standard_normal((64, 64))
    return Foreign({"rms": rms}, lambda image: image * gain[: image.shape[0], : image.shape[1]])


MAKERS = (
    scratch, keystone, unsteady_rows, scattered_light, electronic_ghost_row, charge_trail, flat_field_error,
)  # fmt: skip
FOREIGN: dict[str, Callable[[np.random.Generator], Foreign]] = {one.__name__: one for one in MAKERS}


def displaced_rows(image_e: np.ndarray, shifts_px: np.ndarray) -> np.ndarray:
    """The image with its rows displaced towards larger columns, each by its own of `shifts_px`."""
    y, x = _points(image_e)
    return _looked_at(image_e, np.stack([y, x - shifts_px[:, None]]), 1.0)


def seen_aslant(image_e: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The image with every point r = (y, x) about the axis moved to ``r / (1 − slope·r)``; light is kept.

    `slope` is the relative change of the scale per pixel along (y, x). The point r shows what was at
    ``r / (1 + slope·r)``, where areas are smaller by ``(1 + slope·r)³``.
    """
    points = _points(image_e)
    nearer = 1 + np.tensordot(slope, points, 1)
    return _looked_at(image_e, points / nearer, nearer**-3)


def _points(image_e: np.ndarray) -> np.ndarray:
    """Pixels' places (y, x) about the axis, (2, rows, columns)."""
    return np.stack(np.meshgrid(*(centres(size, 1.0) for size in image_e.shape), indexing="ij"))


def _looked_at(image_e: np.ndarray, points: np.ndarray, area: np.ndarray | float) -> np.ndarray:
    """What pixels of a relative `area` see that look at `points` of an image, (2, rows, columns).

    An image has no frequencies above a third of a cycle per pixel, where splines of the fifth order
    interpolate well.
    """
    middle = -np.array([centres(size, 1.0)[0] for size in image_e.shape])
    seen = ndimage.map_coordinates(image_e, points + middle[:, None, None], order=5, mode="nearest")
    return np.maximum(seen * area, 0.0)
