"""What the light of a ramp may have that its calibration did not show, and the ways to estimate it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from irlos_pipe.paper.common.ramps import NINE, TTF


@dataclass(frozen=True)
class Condition:
    """What is true of a ramp and of no calibration in a narrow band.

    Attributes
    ----------
    label : str
        What it is, for tables.
    bands : {"J+H", "narrow H"}
        Through the lens with frames of a second; or through the narrow filter, by the mirror, as the paper's
        second ramp on sky.
    chromatic_nm : float
        Wavefront between the centres of J and H [nm RMS].
    filter_nm : float
        Wavefront of the lens of the ramp [nm RMS].
    dispersion_mas_per_um, angle_deg : float
        Slope of the displacement at the mean wavelength, and its direction.
    colour_per_um : float
        Relative slope of the star's photons per wavelength beyond that which is assumed [1/µm].
    ways : tuple of str
        Keys of `WAYS` by which it is estimated.
    asked_nm : float, optional
        Error of the defocus asked of the first of them, if any [nm RMS].
    """

    label: str
    ways: tuple[str, ...]
    asked_nm: float | None = None
    bands: Literal["J+H", "narrow H"] = "J+H"
    chromatic_nm: float = 0.0
    filter_nm: float = 0.0
    dispersion_mas_per_um: float = 0.0
    angle_deg: float = 0.0
    colour_per_um: float = 0.0


@dataclass(frozen=True)
class Way:
    """One way to estimate a ramp, beside AO residual and jitter, which are as calibrated or expected.

    Attributes
    ----------
    label : str
    modes : tuple of int
        Noll.
    calibrated : bool
        Whether the NCPAs of the cube are in the model.
    colour : bool
        Dispersion and the slope of the star's spectrum are fitted to all frames together.
    last_noll : int
        Up to which the wavefront of the lens and the one that changes with wavelength are fitted so too; 0
        for neither.
    tilt : {"free", "calibrated", "centroid"}
        Tip and tilt of every frame: estimated, or held at those of the cube or of the centroid.
    """

    label: str
    modes: tuple[int, ...] = TTF
    calibrated: bool = True
    colour: bool = True
    last_noll: int = 0
    tilt: Literal["free", "calibrated", "centroid"] = "free"


DEFAULT, WAVEFRONTS, LOW_WAVEFRONTS, PLAIN = "default", "wavefronts", "low_wavefronts", "plain"
WAYS = {
    DEFAULT: Way("default: dispersion and colour fitted"),
    WAVEFRONTS: Way("chromatic and lens's wavefront fitted too, to Noll 66", last_noll=66),
    LOW_WAVEFRONTS: Way("the same, to Noll 21", last_noll=21),
    PLAIN: Way("neither dispersion nor colour", colour=False),
    "nine": Way("default, nine modes", NINE),
    "astigmatism": Way("default, Noll 6 free", (*TTF, 6)),
    "nine_astigmatism": Way("default, nine modes and Noll 6", tuple(sorted((*NINE, 6)))),
    "tilt_calibrated": Way("default, tip and tilt as calibrated", tilt="calibrated"),
    "tilt_centroid": Way("default, tip and tilt of the centroid", tilt="centroid"),
    "plain_nine": Way("nine modes", NINE, colour=False),
    "uncalibrated": Way("without NCPAs", calibrated=False, colour=False),
    "uncalibrated_nine": Way("without NCPAs, nine modes", NINE, calibrated=False, colour=False),
}
ASKED_NM = 4.0
COLOURS, FRONTS = (DEFAULT, PLAIN), (WAVEFRONTS, DEFAULT)
CONDITIONS = {
    "clean": Condition(
        "nothing",
        (
            DEFAULT,
            PLAIN,
            WAVEFRONTS,
            "nine",
            "astigmatism",
            "nine_astigmatism",
            "tilt_calibrated",
            "tilt_centroid",
            "uncalibrated",
            "uncalibrated_nine",
        ),
        ASKED_NM,
    ),
    "chromatic_30": Condition("chromatic NCPAs of 30 nm", FRONTS, ASKED_NM, chromatic_nm=30.0),
    "chromatic_60": Condition("chromatic NCPAs of 60 nm", FRONTS, ASKED_NM, chromatic_nm=60.0),
    "filter_30": Condition("lens of 30 nm", FRONTS, ASKED_NM, filter_nm=30.0),
    "chromatic_60_filter_30": Condition(
        "chromatic NCPAs of 60 nm, lens of 30 nm",
        (WAVEFRONTS, LOW_WAVEFRONTS, DEFAULT),
        ASKED_NM,
        chromatic_nm=60.0,
        filter_nm=30.0,
    ),
    **{
        f"dispersion_{size}_at_{angle}": Condition(
            f"dispersion of {size} mas/µm at {angle}°",
            COLOURS,
            ASKED_NM,
            dispersion_mas_per_um=size,
            angle_deg=angle,
        )
        for size, angle in ((50, 0), (50, 45), (100, 0), (100, 45), (100, 90))
    },
    "redder": Condition("star redder by 0.5 per µm", COLOURS, ASKED_NM, colour_per_um=0.5),
    "bluer": Condition("star bluer by 0.5 per µm", COLOURS, ASKED_NM, colour_per_um=-0.5),
    "all": Condition(
        "60 nm chromatic, lens 30 nm, 100 mas/µm at 45°, redder",
        FRONTS,
        ASKED_NM,
        chromatic_nm=60.0,
        filter_nm=30.0,
        dispersion_mas_per_um=100.0,
        angle_deg=45.0,
        colour_per_um=0.5,
    ),
    "narrow_h": Condition(
        "narrow H alone, 0.1 s, by the mirror",
        (PLAIN, "plain_nine", "uncalibrated", "uncalibrated_nine"),
        bands="narrow H",
    ),
}
