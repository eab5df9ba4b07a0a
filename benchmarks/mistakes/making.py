"""Cubes of three telescopes, each spoilt or declared wrongly in one way, and the names of the true cause."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import yaml
from astropy.io import fits

from benchmarks.harness import DOCS
from irlos_pipe.conventions.units import MAS
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import Sampling, Scene, draw_ncpa_nm
from irlos_pipe.simulate.telescope import zernike

FRAMES, WINDOW_PX, FLUX_E, READ_E, GAIN_E, LEVEL_ADU = 30, 40, 5e5, 4.0, 2.0, 200.0
CENTRE_NM, WIDTH_NM, DIVERSITY_NM, TOTAL_NM = 1600.0, 24.0, -160.0, 90.0
SHIFTS_NM = (-WIDTH_NM / 3, 0.0, WIDTH_NM / 3)
VLT, OWN, MIDDLE = "vlt", "own", "middle"
SCALES_MAS = {VLT: 9.7, OWN: 40.0, MIDDLE: 20.0}
MIDDLE_PROFILE = {
    "pupil_diameter_m": 4.2, "pupil_obscuration_m": 1.22, "photons_per_s_m15": 40000, "ao_cutoff_per_m": 2.5,
    "pixel_scale_mas": 20,
}  # fmt: skip
LENGTH_M, WIDTH_M, VANES_DEG = 2.2, 0.06, (35.0, 145.0, 215.0, 325.0)
Change = Mapping[str, Any]


@cache
def profile_of(telescope: str, folder: Path) -> str:
    """Return name or path of the profile of a telescope: shipped, of docs/own_telescope.md, or after it."""
    if telescope == VLT:
        return "irlos"
    text = (DOCS / "own_telescope.md").read_text().split("```yaml\n")[1].split("```")[0]
    profile = yaml.safe_load(text)
    if telescope == MIDDLE:
        for name, value in MIDDLE_PROFILE.items():
            profile["facts"][name]["value"] = value
        ends = [np.deg2rad(angle) for angle in VANES_DEG]
        profile["pupil"]["vanes"] = [
            {
                "start_m": [0, 0],
                "end_m": [float(LENGTH_M * np.cos(a)), float(LENGTH_M * np.sin(a))],
                "width_m": WIDTH_M,
            }
            for a in ends
        ]
    profile["name"] = telescope
    path = folder / f"{telescope}.yaml"
    path.write_text(yaml.safe_dump(profile))
    return str(path)


@dataclass(frozen=True)
class Taken:
    """How a cube is taken, and what is declared of it."""

    scale: float = 1.0  # true over declared
    wavelength: float = 1.0
    width: float = 1.0
    rotation_deg: float = 0.0
    bare: bool = False  # no vanes in the telescope
    diversity: Change = field(default_factory=lambda: {6: DIVERSITY_NM})  # in the light
    jitter: float = 0.15  # of λ/D
    sky: bool = False
    spoil: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None  # mean images [e-]
    record: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None  # counts
    side: Change = field(default_factory=dict)  # keys of the side-car
    settings: Sequence[str] = ()  # of the recipe
    profile: bool = False  # whether that of another telescope is taken instead of its own


def made(
    telescope: str, taken: Taken, seed: tuple[int, ...], folder: Path
) -> tuple[list[str], dict[int, float]]:
    """Write a cube and its side-car; returns the settings that reduce it, and the true modes [nm RMS]."""
    rng = np.random.default_rng(seed)
    instrument = load_instrument(profile_of(telescope, folder))
    ncpa_nm = draw_ncpa_nm(rng, instrument.facility.ncpa_law, TOTAL_NM)
    images = (
        _plain(taken, ncpa_nm, rng)
        if telescope == MIDDLE and not taken.sky
        else _simulated(telescope, taken, ncpa_nm, rng, folder)
    )
    images = images if taken.spoil is None else taken.spoil(images, rng)
    signal = rng.poisson(np.clip(images, 0, None)) + rng.normal(0, READ_E, images.shape)
    adu = np.rint(signal / GAIN_E + LEVEL_ADU)
    adu = np.clip(adu, 0, 65535).astype(np.uint16) if taken.record is None else taken.record(adu, rng)
    fits.PrimaryHDU(adu).writeto(folder / "cube.fits")
    keys = {
        "role": "ncpa_calibration", "exposure_s": 0.1, "frame_rate_hz": 5.0,
        "pixel_scale_mas": SCALES_MAS[telescope],
        "spectrum": [{"wavelength_nm": CENTRE_NM + shift, "weight": 1.0} for shift in SHIFTS_NM],
        "diversity": {"source": "lens", "zernike": {6: DIVERSITY_NM}},
        "detector": {"e_per_adu": GAIN_E, "read_noise_e": READ_E},
    }  # fmt: skip
    (folder / "cube.yaml").write_text(yaml.safe_dump(keys | dict(taken.side)))
    other = "nirc2_narrow" if telescope == VLT else "irlos"
    profile = other if taken.profile else profile_of(telescope, folder)
    effects = "[seeing_halo, tip_tilt_jitter]" if taken.sky else "[tip_tilt_jitter]"
    settings = [
        f"instrument={profile}",
        f"model.effects={effects}",
        "calibrate.highest_noll=66",
        *taken.settings,
    ]
    return settings, ncpa_nm


def _simulated(
    telescope: str, taken: Taken, ncpa_nm: Change, rng: np.random.Generator, folder: Path
) -> np.ndarray:
    """Mean images of the frames by the simulator, (frames, rows, columns) [e-]."""
    facility = load_instrument(profile_of(telescope, folder)).facility
    if taken.bare:
        facility = replace(facility, pupil=replace(facility.pupil, vanes=()))
    scene = Scene(
        "mistakes",
        facility,
        (Band(taken.wavelength * CENTRE_NM, taken.wavelength * taken.width * WIDTH_NM / 2),),
        (int(rng.integers(2**31)),),
        FRAMES,
        0.1,
        mag_j=15 + 2.5 * np.log10(facility.photons_per_s_m15 * 0.1 / FLUX_E),
        window=(WINDOW_PX, WINDOW_PX),
        pixel_scale_mas=SCALES_MAS[telescope] * taken.scale,
        pupil_rotation_deg=taken.rotation_deg,
        ncpa_nm=ncpa_nm,
        diversity_nm=taken.diversity,
        sky=Sky(0.6) if taken.sky else None,
        motion=Motion(taken.jitter * CENTRE_NM * 1e-9 / facility.pupil.diameter_m / MAS),
        sampling=Sampling(points_per_band=3, step_s=0.05),
    )
    return expose(scene).mean_e


def _plain(taken: Taken, ncpa_nm: Change, rng: np.random.Generator) -> np.ndarray:
    """The same of the middle telescope by a matrix Fourier transform of a pupil of its own."""
    diameter_m, hole_m, samples, over = 4.2, 1.22, 192, 3
    u = (np.arange(samples) - (samples - 1) / 2) * diameter_m / samples
    x, y = np.meshgrid(u, u)
    pupil = np.clip((diameter_m / 2 - np.hypot(x, y)) * samples / diameter_m + 0.5, 0, 1)
    pupil *= np.clip((np.hypot(x, y) - hole_m / 2) * samples / diameter_m + 0.5, 0, 1)
    for angle in () if taken.bare else np.deg2rad(np.add(VANES_DEG, taken.rotation_deg)):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        dark = np.clip((WIDTH_M / 2 - np.abs(across)) * samples / diameter_m + 0.5, 0, 1)
        pupil *= 1 - dark * (along > 0)
    known = {
        noll: ncpa_nm.get(noll, 0.0) + taken.diversity.get(noll, 0.0) for noll in {*ncpa_nm, *taken.diversity}
    }
    scaled = 2 * x / diameter_m, 2 * y / diameter_m
    opd_nm = np.sum([nm * zernike(noll, *scaled) for noll, nm in known.items()], axis=0)
    moved = rng.normal(0, taken.jitter * CENTRE_NM * 1e-9 / diameter_m, (FRAMES, 2))
    pixel = SCALES_MAS[MIDDLE] * taken.scale * MAS
    angles = (np.arange(WINDOW_PX * over) - (WINDOW_PX * over - 1) / 2) * pixel / over
    images = np.zeros((FRAMES, WINDOW_PX, WINDOW_PX))
    for shift_nm in np.array([-1, 0, 1]) * WIDTH_NM / 3 * taken.width:
        wave = taken.wavelength * (CENTRE_NM + shift_nm) * 1e-9
        field_ = pupil * np.exp(2j * np.pi * opd_nm * 1e-9 / wave)
        scale = FLUX_E / 3 / np.sum(pupil**2) * (diameter_m / samples * pixel / over / wave) ** 2
        for image, (dx, dy) in zip(images, moved, strict=True):
            rows, columns = (np.exp(-2j * np.pi * np.outer(angles - d, u) / wave) for d in (dy, dx))
            fine = np.abs(rows @ field_ @ columns.T) ** 2 * scale
            image += fine.reshape(WINDOW_PX, over, WINDOW_PX, over).sum(axis=(1, 3))
    return images


# -- the mistakes -------------------------------------------------------------------------------


def companion(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A second star of 2 to 8 % of the light, 8 to 14 px away."""
    angle, distance, part = rng.uniform(0, 2 * np.pi), rng.uniform(8, 14), rng.uniform(0.02, 0.08)
    shift = (0.0, distance * np.sin(angle), distance * np.cos(angle))
    return images + part * scipy.ndimage.shift(images, shift, order=3)


def dark_left(adu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Counts with the dark left in: a glow, unequal pixels, two hot ones."""
    y, x = np.indices(adu.shape[1:]) / WINDOW_PX
    corner = rng.uniform(0, 1, 2) > 0.5
    glow = rng.uniform(50, 150) * np.exp(-np.hypot(y - corner[0], x - corner[1]) / rng.uniform(0.2, 0.5))
    dark = glow + rng.uniform(5, 30) * rng.standard_normal(adu.shape[1:])
    dark[tuple(rng.integers(WINDOW_PX, size=(2, 2)))] += 3000
    return np.clip(np.rint(adu + dark), 0, 65535).astype(np.uint16)


def wrapped(adu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Counts beyond an integer of 16 bits with its sign."""
    factor = rng.uniform(1.1, 1.6) * 32767 / adu.max()
    return (np.rint(adu * factor).astype(np.int64) % 65536).astype(np.uint16).view(np.int16)


def clipped(adu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.minimum(adu, rng.uniform(0.4, 0.8) * adu.mean(axis=0).max()).astype(np.uint16)


def nonlinear(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return images * (1 - rng.uniform(0.04, 0.12) * images / images.mean(axis=0).max())


def shared(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    part = rng.uniform(0.02, 0.05)
    kernel = np.array([[0, part, 0], [part, 1 - 4 * part, part], [0, part, 0]])
    return scipy.ndimage.convolve(images, kernel[None])


def mixed(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Half of the frames of another star, through the same optics upside down."""
    return np.concatenate([images[::2], images[1::2, ::-1, ::-1]])


def no_rows(adu: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = adu.astype(np.uint16)
    out[:, 4:7] = 0
    return out


def counts(change: Callable[[np.ndarray], np.ndarray], dtype: type = np.uint16) -> Taken:
    """A cube whose counts are changed before they are written."""
    return Taken(record=lambda adu, rng: change(adu).astype(dtype))


def declared(**keys: Any) -> Taken:
    """A cube of which the side-car says something else."""
    return Taken(side=keys)


def diverse(noll: int, nm: float) -> Change:
    return {"source": "lens", "zernike": {noll: nm}}


def detector(gain: float = 1.0, noise: float = 1.0) -> Change:
    return {"e_per_adu": GAIN_E * gain, "read_noise_e": READ_E * noise}


def far(rng: np.random.Generator, low: float = 0.015, high: float = 0.06) -> float:
    """A factor, as often below as above one."""
    return 1 + float(rng.uniform(low, high) * rng.choice([-1, 1]))


SCALE = ("plate_scale", "spectrum")  # in a narrow band the two are one
DIVERSE, TURNED = ("diversity",), ("orientation", "pupil_rotation")
PUPIL, CHARGE = ("pupil_geometry",), ("interpixel_crosstalk", "motion")
NOTHING, MOVES = ("model.effects=[]",), ("model.effects=[tip_tilt_jitter]",)
Rng = np.random.Generator
# Mistake: names of its true cause, and how a cube with it is taken.
MISTAKES: dict[str, tuple[tuple[str, ...], Callable[[Rng], Taken]]] = {
    "none": ((), lambda rng: Taken()),
    "pixel scale": (SCALE, lambda rng: Taken(scale=far(rng))),
    "wavelength": (SCALE, lambda rng: Taken(wavelength=far(rng))),
    "band width": (("spectrum",), lambda rng: Taken(width=float(rng.uniform(3, 5)))),
    "diversity in Noll 5": (DIVERSE, lambda rng: declared(diversity=diverse(5, DIVERSITY_NM))),
    "diversity in um": (DIVERSE, lambda rng: declared(diversity=diverse(6, DIVERSITY_NM / 1000))),
    "diversity sign": (DIVERSE, lambda rng: declared(diversity=diverse(6, -DIVERSITY_NM))),
    "lens missing": (DIVERSE, lambda rng: Taken(diversity={})),
    "transposed": (TURNED, lambda rng: counts(lambda adu: np.swapaxes(adu, 1, 2))),
    "flipped": (TURNED, lambda rng: counts(lambda adu: adu[:, ::-1])),
    "turned by 90": (TURNED, lambda rng: counts(lambda adu: np.rot90(adu, 1, (1, 2)))),
    "turned by 180": (TURNED, lambda rng: counts(lambda adu: adu[:, ::-1, ::-1])),
    "pupil turned": (TURNED, lambda rng: Taken(rotation_deg=float(rng.uniform(8, 30)))),
    "no vanes": (PUPIL, lambda rng: Taken(bare=True)),
    "forgotten profile": (("profile", "plate_scale"), lambda rng: Taken(profile=True)),
    "forgotten dark": (("background",), lambda rng: Taken(record=dark_left)),
    "gain x10": (("gain",), lambda rng: declared(detector=detector(gain=10.0))),
    "gain by 5": (("gain",), lambda rng: declared(detector=detector(gain=0.2))),
    "normalised": (("gain",), lambda rng: counts(lambda adu: (adu - LEVEL_ADU) / adu.max(), np.float32)),
    "read noise x20": (("read_noise",), lambda rng: declared(detector=detector(noise=20.0))),
    "overflow": (("overflow",), lambda rng: Taken(record=wrapped)),
    "saturated": (("saturation",), lambda rng: Taken(record=clipped)),
    "non-linear": (("detector_nonlinearity",), lambda rng: Taken(spoil=nonlinear)),
    "cross-talk": (CHARGE, lambda rng: Taken(spoil=shared, settings=NOTHING, jitter=0.01)),
    "motion left out": (CHARGE, lambda rng: Taken(jitter=0.3, settings=NOTHING)),
    "halo left out": (("seeing_halo",), lambda rng: Taken(sky=True, settings=MOVES)),
    "companion": (("companion",), lambda rng: Taken(spoil=companion)),
    "two kinds of frames": (("mixed_frames",), lambda rng: Taken(spoil=mixed)),
    "three rows of zeros": (("bad_pixels",), lambda rng: Taken(record=no_rows)),
    "time is last": (("axes",), lambda rng: counts(lambda adu: np.moveaxis(adu, 0, 2))),
    "three frames": (("frames",), lambda rng: replace(counts(lambda adu: adu[:3]), sky=True)),
    "one frame": (("frames",), lambda rng: replace(counts(lambda adu: adu[:1]), sky=True)),
}
# What physics cannot tell from one cube: mistake, and a word of the line by which the report says so.
UNDECIDABLE = {
    "diversity in Noll 5": "mode of the diversity", "diversity in um": "mode of the diversity",
    "lens missing": "mode of the diversity",
    "diversity sign": "sign of the even modes", "transposed": "transposed", "turned by 180": "turned by 180",
    "flipped": "mirrored", "turned by 90": "transposed", "forgotten dark": "dark that is smooth",
}  # fmt: skip
