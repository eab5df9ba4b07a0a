"""Light and errors behind adaptive optics that the model does not resemble, and that share no code with it.

Layers of frozen von Kármán turbulence drift over the pupil; a Hartmann sensor or a pyramid sees them towards
a natural star or through the cones of lasers, an integrator with delay drives a zonal mirror, and tomography
by covariances joins several lasers. A light is right if it is red just where the error of Noll 4–30, against
the static NCPAs, is above what the check allows.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import factorial
from pathlib import Path

import click
import numpy as np
from astropy.io import fits
from scipy.special import gamma, kv

from benchmarks import harness
from benchmarks.harness import Outcome, Suite, markdown
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.recipe import load_recipe

DIAMETER_M, HOLE_M, PIXEL_MAS, WAVE_NM = 8.0, 1.116, 9.7, 1600.0
SCREEN, STEP_M, OUTER_M = 1024, 0.05, 25.0  # samples of a periodic screen, their pitch, outer scale
WINDOW, FRAMES, SAMPLES, RATE_HZ = (
    48,
    40,
    10,
    500,
)  # px; exposures of 0.1 s, images in each; steps of the loop
FLUX_E, NOISE_E, GAIN = 1.2e7, 5.0, 20.0  # of a frame; of a pixel; e-/ADU
LASER_M, MAS, PER_RAD = 90e3, np.pi / 180 / 3.6e6, 500 / 2 / np.pi
GRID, PUPIL = 81, 160  # samples across the pupil of sensor and mirror (0.1 m), and of images
TRUE_NOLLS = range(2, 121)
REPORTED, LIMIT_NM = range(4, 31), 12.0
SIDECAR = {
    "role": "ncpa_calibration",
    "mag_j": 7.0,
    "exposure_s": 0.1,
    "frame_rate_hz": 10,
    "pixel_scale_mas": PIXEL_MAS,
    "spectrum": [{"wavelength_nm": WAVE_NM, "weight": 1.0}],
    "diversity": {"source": "lens", "zernike": {6: -170.0}},
    "introduced_defocus_nm": 0.0,
    "derotator_angle_deg": 0.0,
    "detector": {"e_per_adu": GAIN, "read_noise_e": NOISE_E},
}


@dataclass(frozen=True)
class Kind:
    """An adaptive optics under a sky."""

    seeing_arcsec: float
    layers: tuple[tuple[float, float, float, float], ...]  # height [m], part, wind along x and y [m/s]
    pitch: int = 2  # of the actuators [0.1 m]
    lasers_arcsec: tuple[float, ...] = ()  # their distances from the axis; none: natural star
    pyramid: bool = False
    gain: float = 0.5
    leak: float = 1.0
    delay: int = 1  # steps
    noise_nm: float = 40.0  # of an edge of a subaperture, or of a pyramid's phase


SKY = ((0.0, 0.55, 6.0, 3.0), (4500.0, 0.25, -9.0, 10.0), (11000.0, 0.20, 14.0, -18.0))
HIGH = ((0.0, 0.45, -5.0, 7.0), (6000.0, 0.25, 12.0, 4.0), (14000.0, 0.30, 22.0, 9.0))
ALONG = ((0.0, 0.5, 18.0, 0.0), (5000.0, 0.3, 26.0, 0.0), (10000.0, 0.2, 34.0, 0.0))
KINDS = {
    "natural_1.0": Kind(1.0, SKY),
    "one_laser_0.8": Kind(0.8, SKY, lasers_arcsec=(0.0,)),
    "four_lasers_0.8": Kind(0.8, SKY, pitch=4, lasers_arcsec=(10.0,) * 4),
    "pyramid_0.5": Kind(0.5, HIGH, pyramid=True, noise_nm=15.0),
    "wind_0.8": Kind(0.8, ALONG, delay=2, gain=0.4),
    "four_lasers_1.0": Kind(1.0, HIGH, pitch=4, lasers_arcsec=(20.0,) * 4),
    "one_laser_0.5": Kind(0.5, HIGH, lasers_arcsec=(0.0,)),
    "coarse_0.8": Kind(0.8, HIGH, pitch=4, leak=0.98, gain=0.35, noise_nm=80.0),
}


@dataclass(frozen=True)
class Case:
    """One cube; all draws follow from `seed`."""

    kind: str
    seed: int

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.kind}_{self.seed}"

    @property
    def key(self) -> tuple:
        """What its outcome must say of it."""
        return self.kind, self.seed


# -- the sky and the loop ------------------------------------------------------------------------


def screen(rng: np.random.Generator, seeing_arcsec: float) -> np.ndarray:
    """Phase of all of the turbulence [nm], periodic."""
    f = np.fft.fftfreq(SCREEN, STEP_M)
    power = 0.0229 * r0_m(seeing_arcsec) ** (-5 / 3) * (f[:, None] ** 2 + f**2 + OUTER_M**-2) ** (-11 / 6)
    root = np.sqrt(power) * PER_RAD / (SCREEN * STEP_M)
    root[0, 0] = 0
    white = np.fft.fft2(rng.standard_normal((SCREEN, SCREEN)))
    return (np.fft.ifft2(white * root).real * SCREEN).astype(np.float32)


def r0_m(seeing_arcsec: float) -> float:
    return 0.98 * 500e-9 / (seeing_arcsec * 1000 * MAS)


def looked_up(plane: np.ndarray, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """A periodic screen at rows y and columns x, linear between its samples."""
    for at in (y_m, x_m):
        place = at / STEP_M
        low = np.floor(place).astype(int)
        part = (place - low).astype(np.float32)[:, None]
        plane = ((1 - part) * plane[low % SCREEN] + part * plane[(low + 1) % SCREEN]).T
    return plane


def covariance_nm2(seeing_arcsec: float, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of von Kármán phase at places a and b (m, 2)."""
    z = 2 * np.pi * np.maximum(np.linalg.norm(a[:, None] - b[None], axis=2), 1e-3) / OUTER_M
    variance = 0.0858 * (OUTER_M / r0_m(seeing_arcsec)) ** (5 / 3) * PER_RAD**2
    return variance * 2 ** (1 / 6) / gamma(5 / 6) * z ** (5 / 6) * kv(5 / 6, z)


def tomography(kind: Kind, at: np.ndarray, stars: Sequence[np.ndarray]) -> np.ndarray:
    """Phase on the axis at places (m, 2) by that seen towards the lasers without tilts, (m, stars m)."""
    plane = np.column_stack([np.ones(len(at)), at])
    clean = np.eye(len(at)) - plane @ np.linalg.pinv(plane)
    every = np.kron(np.eye(len(stars)), clean)
    inner, outer = 0.0, 0.0
    for height, part, *_ in kind.layers:
        seen = np.concatenate([at * (1 - height / LASER_M) + star * height for star in stars])
        inner = inner + part * covariance_nm2(kind.seeing_arcsec, seen, seen)
        outer = outer + part * covariance_nm2(kind.seeing_arcsec, at, seen)
    noise = (0.5 * kind.noise_nm) ** 2 * np.eye(len(every))
    return clean @ outer @ every @ np.linalg.inv(every @ inner @ every + noise)


class Loop:
    """Turbulence, sensor, mirror and control; `step` advances it."""

    def __init__(self, kind: Kind, rng: np.random.Generator):
        self.kind, self.rng = kind, rng
        self.screens = [screen(rng, kind.seeing_arcsec) * np.sqrt(part) for _, part, *_ in kind.layers]
        self.u_m = (np.arange(GRID) - GRID // 2) * 0.1
        self.actuators_m = np.arange(-40, 41, kind.pitch) * 0.1
        angles = np.arange(len(kind.lasers_arcsec)) * np.pi / 2 + np.pi / 4
        radii = np.array(kind.lasers_arcsec) * 1000 * MAS
        self.stars = list(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1))
        self._sensor()
        design = self._design()
        normal = design.T @ design
        regular = 0.02 if len(self.stars) < 2 else 5e-4
        normal += regular * np.trace(normal) / len(normal) * np.eye(len(normal))
        self.control = np.linalg.solve(normal, design.T).astype(np.float32)
        self.command = self.high = self.low = np.zeros(self.driven.sum())
        several = len(self.stars) > 1
        if several:  # the mirror's shape at its actuators, and the command that makes a shape there
            inside = self.influence(self.actuators_m)
            self.shaped = np.kron(inside, inside)[self.driven.ravel()][:, self.driven.ravel()]
            gram = self.shaped.T @ self.shaped
            gram += 1e-3 * np.trace(gram) / len(gram) * np.eye(len(gram))
            place = np.stack(np.meshgrid(self.actuators_m, self.actuators_m), -1)[self.driven]
            self.joined = np.linalg.solve(gram, self.shaped.T) @ tomography(kind, place, self.stars)
        self.waiting = [np.zeros(2 * len(self.command) if several else len(design))] * kind.delay

    def influence(self, x_m: np.ndarray) -> np.ndarray:
        pitch_m = self.kind.pitch * 0.1
        return np.exp(-(((x_m[:, None] - self.actuators_m) / pitch_m) ** 2) * np.log(4))

    def _sensor(self) -> None:
        subapertures, pitch = len(self.actuators_m) - 1, self.kind.pitch
        self.mean, self.difference = np.zeros((2, subapertures, GRID))
        weight = np.ones(pitch + 1)
        weight[[0, -1]] = 0.5
        for i in range(subapertures):
            self.mean[i, i * pitch : (i + 1) * pitch + 1] = weight / pitch
            self.difference[i, [i * pitch, (i + 1) * pitch]] = -1, 1
        middle = (self.actuators_m[1:] + self.actuators_m[:-1]) / 2
        self.valid = self._ring(middle, HOLE_M / 2, DIAMETER_M / 2 - 0.02 * pitch)
        self.lit = self._ring(self.u_m, HOLE_M / 2, DIAMETER_M / 2)
        self.driven = self._ring(self.actuators_m, HOLE_M / 2 - 0.1 * pitch, DIAMETER_M / 2 + 0.08 * pitch)

    def _ring(self, x_m: np.ndarray, inner_m: float, outer_m: float) -> np.ndarray:
        radius = np.hypot(*np.meshgrid(x_m, x_m))
        return (radius < outer_m) & (radius > inner_m)

    def _design(self) -> np.ndarray:
        """What the sensor sees of every actuator."""
        at, driven = self.influence(self.u_m), self.driven.ravel()
        if self.kind.pyramid:
            return np.kron(at, at)[self.lit.ravel()][:, driven]
        a, b = self.mean @ at, self.difference @ at
        return np.concatenate([np.kron(one, other)[self.valid.ravel()] for one, other in ((a, b), (b, a))])[
            :, driven
        ]

    def slopes(self, phase_nm: np.ndarray) -> np.ndarray:
        x, y = self.mean @ phase_nm @ self.difference.T, self.difference @ phase_nm @ self.mean.T
        return np.concatenate([x[self.valid], y[self.valid]])

    def _tilt(self, slopes: np.ndarray) -> np.ndarray:
        return np.repeat(slopes.reshape(2, -1).mean(axis=1), len(slopes) // 2)

    def sky_nm(self, second: float, x_m: np.ndarray, star: np.ndarray | None = None) -> np.ndarray:
        total = np.zeros((len(x_m), len(x_m)), np.float32)
        for plane, (height, _, vx, vy) in zip(self.screens, self.kind.layers, strict=True):
            grow, off = (1.0, np.zeros(2)) if star is None else (1 - height / LASER_M, star * height)
            total += looked_up(plane, x_m * grow + off[0] + vx * second, x_m * grow + off[1] + vy * second)
        return total

    def mirror_nm(self, x_m: np.ndarray) -> np.ndarray:
        surface = np.zeros(self.driven.shape)
        surface[self.driven] = self.command
        return self.influence(x_m) @ surface @ self.influence(x_m).T

    def step(self, second: float) -> None:
        """Measure, and command what was measured some steps ago."""
        kind, mirror = self.kind, self.mirror_nm(self.u_m)
        self.waiting.append(self._measured(second, mirror).astype(np.float32))
        old = self.waiting.pop(0)
        if len(self.stars) < 2:
            self.command = kind.leak * self.command + kind.gain * (self.control @ old)
            return
        self.high = (1 - kind.gain) * self.high + kind.gain * old[: len(self.high)]
        self.low = self.low + kind.gain * old[len(self.high) :]
        self.command = self.high + self.low

    def _measured(self, second: float, mirror: np.ndarray) -> np.ndarray:
        noise_nm, axis = self.kind.noise_nm, self.sky_nm(second, self.u_m)
        if self.kind.pyramid:
            seen = (axis - mirror)[self.lit]
            return seen - seen.mean() + noise_nm * self.rng.standard_normal(len(seen))
        drawn = [noise_nm * self.rng.standard_normal(2 * self.valid.sum()) for _ in self.stars or [None]]
        if not self.stars:
            return self.slopes(axis - mirror) + drawn[0]
        tilt = self._tilt(self.slopes(axis - mirror))  # of a natural star
        views = [self.sky_nm(second, self.u_m, star) for star in self.stars]
        if len(views) == 1:
            seen = self.slopes(views[0] - mirror) + drawn[0]
            return seen - self._tilt(seen) + tilt
        seen = [self.slopes(view) + noise for view, noise in zip(views, drawn, strict=True)]
        waves = [self.shaped @ (self.control @ (one - self._tilt(one)).astype(np.float32)) for one in seen]
        return np.concatenate([self.joined @ np.concatenate(waves), self.control @ tilt.astype(np.float32)])


# -- images --------------------------------------------------------------------------------------


def pupil(samples: int, finer: int = 12) -> np.ndarray:
    """Transmission, grey at the edges, with the vanes of UT4."""
    u = ((np.arange(samples * finer) + 0.5) / (samples * finer) - 0.5) * DIAMETER_M
    x, y = np.meshgrid(u, u)
    light = (np.hypot(x, y) < DIAMETER_M / 2) & (np.hypot(x, y) > HOLE_M / 2)
    for side in (1, -1):
        start = side * 0.4045 / np.cos(np.radians(39.5)) / np.sqrt(2)
        for end in ((side * 4.2197, 0.0), (0.0, side * 4.2197)):
            along = (np.array(end) - start) / np.linalg.norm(np.array(end) - start)
            dx, dy = x - start, y - start
            aside, ahead = dx * along[1] - dy * along[0], dx * along[0] + dy * along[1]
            light &= ~((np.abs(aside) < 0.02) & (ahead > 0))
    return light.reshape(samples, finer, samples, finer).mean((1, 3))


def zernike(noll: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    n, left = 0, noll - 1
    while left > n:
        n += 1
        left -= n
    m = n % 2 + 2 * ((left + (n + 1) % 2) // 2)
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    radial = sum(
        (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        * rho ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )
    if m == 0:
        return np.sqrt(n + 1) * radial
    return np.sqrt(2 * n + 2) * radial * (np.cos(m * theta) if noll % 2 == 0 else np.sin(m * theta))


def world(kind: Kind, seed: int) -> tuple[np.ndarray, dict[int, float], dict[int, float]]:
    """Frames [ADU]; NCPAs, and the mean residual of the frames, by Noll index [nm RMS]."""
    rng = np.random.default_rng(seed)
    loop = Loop(kind, rng)
    x_m = ((np.arange(PUPIL) + 0.5) / PUPIL - 0.5) * DIAMETER_M
    aperture, at = pupil(PUPIL), np.meshgrid(x_m * 2 / DIAMETER_M, x_m * 2 / DIAMETER_M)
    modes = {noll: zernike(noll, *at) for noll in TRUE_NOLLS}
    law = 70 * np.exp(-0.2 * np.arange(50)) + 10
    law[:2] = np.sqrt(np.mean(law[:2] ** 2))
    drawn = rng.standard_normal(50) * law
    drawn *= (142 + 30 * np.clip(rng.standard_normal(), -2, 2)) / np.linalg.norm(drawn)
    ncpa_nm = dict(zip(range(2, 52), drawn.tolist(), strict=True))
    static = sum(nm * modes[noll] for noll, nm in ncpa_nm.items()) - 170.0 * modes[6]
    nodes, weights = np.array([-0.3872983346, 0, 0.3872983346]), np.array([5, 8, 5]) / 18
    pixels = ((np.arange(WINDOW) - (WINDOW - 1) / 2)[:, None] + nodes).ravel() * PIXEL_MAS * MAS
    kernel = np.exp(-2j * np.pi * np.outer(pixels, x_m) / (WAVE_NM * 1e-9)).astype(np.complex64)
    scale = FLUX_E * (0.05 * PIXEL_MAS * MAS / (WAVE_NM * 1e-9)) ** 2 / np.sum(aperture**2)
    basis = np.column_stack([aperture.ravel(), *((modes[j] * aperture).ravel() for j in TRUE_NOLLS)])
    images, total = np.zeros((FRAMES, WINDOW, WINDOW)), np.zeros((PUPIL, PUPIL))
    settled, steps = 150, RATE_HZ // 10
    for k in range(settled + FRAMES * steps):
        frame, within = divmod(k - settled, steps)
        if k >= settled and within % (steps // SAMPLES) == 0:
            left = loop.sky_nm(k / RATE_HZ, x_m) - loop.mirror_nm(x_m)
            left -= np.average(left, weights=aperture)
            field = (aperture * np.exp(2j * np.pi / WAVE_NM * (left + static))).astype(np.complex64)
            power = np.abs(kernel @ field @ kernel.T) ** 2
            images[frame] += np.einsum("iajb,a,b->ij", power.reshape(WINDOW, 3, WINDOW, 3), weights, weights)
            total += left
        loop.step(k / RATE_HZ)
    mean = (total / (FRAMES * SAMPLES) * aperture).ravel()
    averaged = np.linalg.solve(basis.T @ basis, basis.T @ mean)[1:]
    images *= scale / SAMPLES
    adu = (rng.poisson(images) + NOISE_E * rng.standard_normal(images.shape)) / GAIN
    return adu.astype(np.float32), ncpa_nm, dict(zip(TRUE_NOLLS, averaged.tolist(), strict=True))


# -- what comes of it ----------------------------------------------------------------------------


def outcome_of(case: Case, *_) -> Outcome:
    """Simulate and calibrate a `case`."""
    kind = KINDS[case.kind]
    adu, ncpa_nm, mean_nm = world(kind, case.seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.fits"
        fits.writeto(path, adu)
        path.with_suffix(".yaml").write_text(yaml_text(SIDECAR | {"seeing_arcsec": kind.seeing_arcsec}))
        ran = run_recipe(load_recipe("ncpa_calibration", [], [f"calibration={path}"]), Path(folder) / "run")
    stage = ran.results["stages"]["calibrate"]
    return {
        "kind": case.kind,
        "seed": case.seed,
        "exit_code": ran.exit_code,
        "failed": [check["name"] for check in ran.quality["checks"] if not check["passed"]],
        "ncpa_nm": ncpa_nm,
        "mean_nm": mean_nm,
        **{key: stage[key] for key in ("zernike_nm", "sigma_nm", "chi2_nu", "nominal_chi2_nu")},
    }


def total_nm(values_nm: Mapping[str, float]) -> np.ndarray:
    return np.array([values_nm.get(str(noll), 0.0) for noll in REPORTED])


def table(outcomes: Sequence[Outcome], *_) -> str:
    """Return errors, what was quoted, and lights."""
    rows, right, held = [], 0, 0
    for one in outcomes:
        error = total_nm(one["zernike_nm"]) - total_nm(one["ncpa_nm"])
        static, quoted = np.linalg.norm(error), np.linalg.norm(total_nm(one["sigma_nm"]))
        of_mean, red = np.linalg.norm(error - total_nm(one["mean_nm"])), one["exit_code"] == 4
        right += red == (static > LIMIT_NM)
        held += 0.7 <= quoted / static <= 1.5
        rows.append(
            [
                f"{one['kind']} {one['seed']}",
                *(f"{nm:.1f}" for nm in (static, of_mean, quoted)),
                f"{quoted / static:.2f}",
                f"{one['chi2_nu']:.2f}; {one['nominal_chi2_nu']:.2f}",
                "red" if red else "green",
            ]
        )
    head = ("world", "error [nm]", "… of the mean", "quoted", "quoted over true", "χ²/ν; nominal", "light")
    count = len(outcomes)
    return (
        markdown(head, rows)
        + f"\n\nLight right: {right} of {count}. Quoted 0.7–1.5 of true: {held} of {count}."
    )


def key_of(outcome: Outcome) -> tuple:
    """Return what an outcome says of its case."""
    return outcome["kind"], outcome["seed"]


SUITE = Suite(outcome_of, key_of, table)


@click.command()
@harness.options(1)
@click.option("--draws", default=3, show_default=True, help="Of every kind, seeds from --seed on.")
def main(draws: int, seed: int, **how) -> None:
    """Simulate cubes behind adaptive optics unlike the model's; compare light and errors with the truth."""
    harness.run(SUITE, [Case(kind, seed + i) for i in range(draws) for kind in KINDS], **how)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.foreign")
