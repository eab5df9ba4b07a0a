"""What can go wrong with the light and with the pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from benchmarks.focus_faults.rig import Rig
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion

Spoil = Callable[[np.ndarray, int, Rig, np.random.Generator], np.ndarray]
COLUMN = np.arange(64)


def _plain(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda image, number, rig, rng: np.ascontiguousarray(change(image), np.float32)


def _clipped(part: float) -> Spoil:
    return _plain(lambda image: np.minimum(image, part * image.max()))


def _shoulder(part: float) -> Spoil:
    return _plain(lambda image: part * image.max() * np.tanh(image / (part * image.max())))


def _torn(pixels: int) -> Spoil:
    return _plain(lambda image: np.concatenate([image[:32], np.roll(image[32:], pixels, 1)]))


def _gamma(power: float) -> Spoil:
    return _plain(lambda image: image.max() * (np.maximum(image, 0) / image.max()) ** power)


def _two_pointings(pixels: int) -> Spoil:
    return _plain(lambda image: (image + np.roll(image, pixels, 1)) / 2)


def _two_focuses(apart_nm: float) -> Spoil:
    def mixed(image: np.ndarray, number: int, rig: Rig, rng: np.random.Generator) -> np.ndarray:
        residual_nm = rig.drift_nm[rig.before + number] - rig.applied_nm
        both = [rig.image(residual_nm + side * apart_nm / 2, rig.look)[0] for side in (-1, 1)]
        return np.mean(both, axis=0)

    return mixed


def _scaled(factor: float) -> Spoil:
    centre = (COLUMN - 31.5) / factor + 31.5
    points = np.meshgrid(centre, centre, indexing="ij")
    return _plain(lambda image: map_coordinates(image, points, order=1, mode="nearest"))


def _half(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def halved(image: np.ndarray) -> np.ndarray:
        column = int(gaussian_filter(image, 1).argmax() % 64)
        return np.concatenate([image[:, :column], change(image[:, column:])], axis=1)

    return _plain(halved)


def _shower(image: np.ndarray, number: int, rig: Rig, rng: np.random.Generator) -> np.ndarray:
    hit = image.copy()
    where = rng.integers(0, 64, (2, 200))
    hit[tuple(where)] += rng.exponential(0.3 * image.max(), 200)
    return hit


def _star_in_core(image: np.ndarray, number: int, rig: Rig, rng: np.random.Generator) -> np.ndarray:
    hit = image.copy()
    row, column = np.unravel_index(gaussian_filter(image, 1).argmax(), image.shape)
    hit[row, column + 2] += 1.5 * image.max()
    return hit


def _smeared(image: np.ndarray) -> np.ndarray:
    kernel = 0.85 ** np.arange(12)
    return np.stack([np.convolve(row, kernel / kernel.sum())[:64] for row in image])


def _coded(image: np.ndarray) -> np.ndarray:
    """As a lossy compression leaves it: the coarse half of the frequencies."""
    far = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64))) > 0.12
    return np.fft.ifft2(np.where(far, 0, np.fft.fft2(image))).real


def _quadrants_rolled(image: np.ndarray) -> np.ndarray:
    parts = [np.hsplit(half, 2) for half in np.vsplit(image, 2)]
    return np.block([[np.roll(parts[i][j], 5 * (i - j), 1) for j in (0, 1)] for i in (0, 1)])


def _other_lines(image: np.ndarray, number: int, rig: Rig, rng: np.random.Generator) -> np.ndarray:
    return np.where(COLUMN[:, None] % 2, image, np.roll(rig.images[-1], (2, 1), (0, 1)))


# Known kinds: light that another optics, another motion or another detector makes.
PIXELS: dict[str, Spoil] = {
    "frozen": lambda image, number, rig, rng: rig.images[-1],
    "frozen, two by turns": lambda image, number, rig, rng: rig.images[-2],
    "frozen half": lambda image, number, rig, rng: np.concatenate([image[:32], rig.images[-1][32:]]),
    "two pointings, 19 mas": _two_pointings(2),
    "core clipped at 50 %": _clipped(0.5),
    "core clipped at 30 %": _clipped(0.3),
    "torn by 1 px": _torn(1),
    "torn by 3 px": _torn(3),
    "mirrored": _plain(np.fliplr),
    "transposed": _plain(np.transpose),
    "not a number": _plain(lambda image: np.full_like(image, np.nan)),
}
LOOKS: dict[str, dict[str, Any]] = {
    "motion of 19 mas": {"motion": Motion(19.0)},
    "motion of 39 mas": {"motion": Motion(39.0)},
    "lens left out": {"diversity_nm": {6: 0.0}},
    "companion of 30 %": {"effects": {"companion": {"flux_ratio": 0.3, "sep_mas": 190, "pa_deg": 30}}},
}
# Further kinds.
MORE_PIXELS: dict[str, Spoil] = {
    "quadrants exchanged": _plain(np.fft.fftshift),
    "quadrants rolled by 5 px": _plain(_quadrants_rolled),
    "gain of one channel x1.4": _half(lambda part: 1.4 * part),
    "gain of one channel x0.7": _half(lambda part: 0.7 * part),
    "one channel of 8 columns dead": _plain(lambda image: image * (COLUMN // 8 != 4)),
    "gain x1.5": _plain(lambda image: 1.5 * image),
    "gain x0.2": _plain(lambda image: 0.2 * image),
    "background gradient": _plain(lambda image: image + 0.3 * image.max() * np.linspace(-1, 1, 64)),
    "background step": _half(lambda part: part + 0.1 * np.abs(part).max()),
    "background pattern of rows": _plain(lambda image: image + 0.1 * image.max() * (COLUMN[:, None] % 4 > 1)),
    "shower of cosmic rays": _shower,
    "cosmic ray beside the core": _star_in_core,
    "soft shoulder at 60 %": _shoulder(0.6),
    "soft shoulder at 30 %": _shoulder(0.3),
    "gamma 1.3": _gamma(1.3),
    "gamma 0.7": _gamma(0.7),
    "bytes swapped": _plain(lambda image: np.nan_to_num(image.byteswap(), nan=0, posinf=0, neginf=0)),
    "words swapped": _plain(lambda image: image.reshape(64, 32, 2)[:, :, ::-1].reshape(64, 64)),
    "dark": lambda image, number, rig, rng: rng.normal(0, 15, image.shape).astype(np.float32),
    "flat": lambda image, number, rig, rng: rng.normal(5000, 70, image.shape).astype(np.float32),
    "noise of the same mean and scatter": lambda image, number, rig, rng: rng.normal(
        image.mean(), image.std(), image.shape
    ).astype(np.float32),
    "negative": _plain(lambda image: -image),
    "two pointings, 100 mas": _two_pointings(10),
    "two pointings, 300 mas": _two_pointings(31),
    "two focuses, 400 nm apart": _two_focuses(400.0),
    "two focuses, 250 nm apart": _two_focuses(250.0),
    "lines of two exposures": _other_lines,
    "star drifting out": lambda image, number, rig, rng: np.roll(image, 22 + 3 * number, 1) * (COLUMN >= 22),
    "binned": _plain(lambda image: np.kron(image.reshape(32, 2, 32, 2).mean((1, 3)), np.ones((2, 2)))),
    "smeared along the lines": _plain(_smeared),
    "sheared": _plain(
        lambda image: np.stack([np.roll(row, index // 8 - 4) for index, row in enumerate(image)])
    ),
    "lossy compression": _plain(_coded),
    "larger by 15 %": _scaled(1.15),
    "smaller by 15 %": _scaled(0.87),
    "convolved with a pixel of 3 px": _plain(lambda image: gaussian_filter(image, 1.3)),
    "thresholded at 10 %": _plain(lambda image: np.where(image > 0.1 * image.max(), image, 0)),
    "core missing": _plain(lambda image: np.where(image > 0.6 * image.max(), 0, image)),
}
LOW_WIND = {"piston_nm": [0.0, 300.0, -250.0, 100.0], "tip_nm": [0.0] * 4, "tilt_nm": [0.0] * 4}
MORE_LOOKS: dict[str, dict[str, Any]] = {
    "NCPAs of another night, 100 nm": {"ncpa_nm": {5: 60.0, 6: -50.0, 7: 50.0, 8: 35.0}},
    "lens of the other sign": {"diversity_nm": {6: 170.0}},
    "lens of twice the strength": {"diversity_nm": {6: -340.0}},
    "H alone": {"bands": (Band(1625.0, 84.0, 1.0),)},
    "J alone": {"bands": (Band(1215.0, 58.0, 1.0),)},
    "K": {"bands": (Band(2150.0, 150.0, 1.0),)},
    "pupil of another telescope": {"facility": load_instrument("nirc2_narrow").facility},
    "second star as bright": {"effects": {"companion": {"flux_ratio": 1.0, "sep_mas": 120, "pa_deg": 100}}},
    "ghost": {"effects": {"ghost": {"flux_ratio": 0.3, "sep_mas": 60, "pa_deg": 200, "defocus_nm": 300.0}}},
    "low wind": {"effects": {"low_wind_effect": LOW_WIND}},
    "vibration": {"effects": {"vibration": {"sigma_mas": 25.0, "angle_deg": 20.0, "frequency_hz": 48.0}}},
}
