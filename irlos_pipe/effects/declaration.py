"""What effects declare of themselves as data: planes, numbers with units and limits, circumstances."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from irlos_pipe.conventions.laws import NcpaLaw, ResidualLaw
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand

INFINITE = float("inf")
Plane = Literal["pupil", "otf", "sampling", "time", "detector", "ramp", "lens"]
Kind = Literal["number", "zernike", "parts", "pixels", "nolls", "word"]
Role = Literal["size", "position", "direction", "component"]
Belongs = Literal["instrument", "star", "moment"]
FoundBy = Literal["score", "frames", "noise", "pixels", "ramp"]


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, as a solver sees it."""

    name: str
    unit: str
    start: float  # where a fit begins
    prior_mean: float = 0.0
    prior_sigma: float = INFINITE  # of the Gaussian prior; infinite without one
    lower: float = -INFINITE  # bounds that a fit respects
    upper: float = INFINITE
    null: float | None = 0.0  # the effect is absent there; None if it says nothing then, as a position
    # A value outside says that the effect stands in for something else.
    plausible: tuple[float, float] = (-INFINITE, INFINITE)
    natural: bool = False  # whether nature sets the bounds: a value there is as good as any other

    @property
    def proper_prior(self) -> tuple[float, float]:
        """Mean and σ of its prior, or of what is equally likely wherever it is plausible."""
        if math.isfinite(self.prior_sigma):
            return self.prior_mean, self.prior_sigma
        mean = self.start if self.null is None else self.null
        ranges = (self.plausible, (self.lower, self.upper), (-math.pi, math.pi))
        low, high = next(one for one in ranges if math.isfinite(one[0]) and math.isfinite(one[1]))
        return mean, (high - low) / math.sqrt(12)

    def allows(self, value: float) -> bool:
        """Whether a `value` is plausible, and not held by a bound that is not natural."""
        low, high = self.plausible
        at_bound = self.null is not None and self.null != value and value in (self.lower, self.upper)
        return low <= value <= high and (self.natural or not at_bound)


@dataclass(frozen=True)
class Public:
    """One number, list or table of an effect, as recipes and results have it."""

    name: str
    unit: str
    lower: float = -INFINITE  # limits of every number in it
    upper: float = INFINITE
    required: bool = True  # whether an effect held at known values must be given it
    # A size grows with the effect; a position or a direction, which is an angle, does not; a component is
    # that of a displacement whose direction does not matter.
    role: Role = "size"
    # A number; a table of Noll indices; numbers of the pupil's parts; a list of (row, column); Noll indices;
    # a name.
    kind: Kind = "number"
    choices: tuple[str, ...] = ()  # what a name may be


class Declared:
    """What an effect says of itself as data."""

    # -- what it is --
    name: str  # as recipes and results have it
    # What it does: to the field of the pupil P exp(2πi Φ/λ), to the OTF as a factor T(b) at the baseline b,
    # to an image I(a) or a signal s.
    formula: str = ""
    plane: Plane  # of the light path on which it acts
    order: int = 0  # among effects of the same plane
    joins: str = ""  # what `together` makes of those with the same word is one effect; by default of one name
    public: tuple[Public, ...] = ()  # numbers under their public names and units
    options: tuple[Public, ...] = ()  # choices that are not estimated, arguments of the constructor
    derived: tuple[Public, ...] = ()  # what results report besides `public`
    parameters: tuple[Parameter, ...] = ()  # as a solver sees them

    # -- what it belongs to --
    usual: bool = False  # in every on-sky recording: a model without a measurement takes it as expected
    instrumental: bool = True  # a calibration can hand it on to a recording of another star at another time
    belongs_to: Belongs = "instrument"  # another star may have another companion, another moment another sky
    fact: bool = False  # corrects what the profile of the instrument states, which is never exact
    varies: bool = False  # a fact that changes with every mounting; others are those of a design
    aberration: bool = False  # part of the static wavefront, which a calibration of NCPAs hands on
    repeatable: bool = False  # a model may have several of its kind

    # -- how a diagnosis looks for it --
    # By a score test of the mean image, from estimates of single frames, from the scatter of the frames,
    # pixel by pixel, or from the offsets of a ramp; the model of an image contains the first two.
    found_by: FoundBy = "score"
    acts_in: frozenset[int] | None = None  # of recordings diagnosed together, the moments; None: all
    mild: bool = False  # a little of it may be in any recording, and it needs no search: facts apart
    blurs: Literal["", "motion", "detector"] = ""  # the image, which hardly distinguishes the causes
    speckles: bool = False  # frames scatter by more than photon noise
    copies_star: bool = False  # adds a displaced image of the star, for which the whole window is searched
    # the effect of which it is a wider form, with further parameters behind; tried only where that is found
    widens: str = ""

    # -- what reports state; format strings of the public values --
    sentence: str = ""
    limit: str = ""  # of the smallest one that would have been seen
    look_alike: str = ""  # what it is most easily mistaken for, and what distinguishes the two
    reference: str = ""


@dataclass(frozen=True)
class Refraction:
    """What is to be expected of atmospheric dispersion at the mean wavelength."""

    mas_per_um: tuple[float, float] = (0.0, 0.0)  # along x and y
    sigma_mas_per_um: float = 300.0  # how far off it may be, along either axis


@dataclass(frozen=True)
class Conditions:
    """Circumstances of a recording that effects may start from."""

    settings: PsfSettings  # window, pixel scale, spectrum and known wavefront
    band: ResidualBand  # spatial frequencies that the AO corrects
    residual_law: ResidualLaw  # AO residual against seeing
    seeing_arcsec: float
    highest_noll: int  # last mode that is estimated as such
    seeing_measured: bool = True  # otherwise the seeing is a typical one
    ncpa_law: NcpaLaw | None = None  # prior of the modes
    numerical_aperture: float = 0.0  # NA / n of the beam in which the focus moves; 0 where it is not known
    elements: tuple[str, ...] = ()  # filter and source of the diversity that the light passes, by name
    # at which NCPAs that differ by wavelength are stated; the mean of the spectrum if None
    ncpa_wavelength_nm: float | None = None
    refraction: Refraction = Refraction()

    @property
    def reference_nm(self) -> float:
        """Wavelength at which NCPAs that differ by wavelength are stated."""
        return self.ncpa_wavelength_nm or self.settings.mean_nm

    @property
    def diversity_nm(self) -> Mapping[int, float]:
        """The introduced diversity by Noll index [nm RMS]."""
        return self.settings.known.diversity_nm

    @property
    def reach_mas(self) -> float:
        """Half the larger side of the window."""
        return max(self.settings.window) / 2 * self.settings.pixel_scale_mas


@dataclass(frozen=True)
class Calibrated:
    """Circumstances under which a calibration found the effects that it hands on."""

    seeing_arcsec: float
    brightest_e: float  # brightest pixel of the modelled mean image, of several cubes the mean of theirs [e-]


def direction(name: str, unit: str = "deg from +x towards +y") -> Public:
    """A public angle, see `Public` for `name` and `unit`."""
    return Public(name, unit, role="direction")
