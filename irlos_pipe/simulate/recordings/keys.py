"""The keys of a simulation spec. Units are in the keys.

A section that the scene has as well is the scene's own class, whose fields say what a key means and may be.
Here is what a scene lacks: drawn aberrations, changes of the instrument's facts, series of recordings. The
keys of `effects` are generated: which parameters an effect has, and which may be left out, stands in the
simulator's class; names, units and limits of those that models have stand in `irlos_pipe.effects`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from datetime import datetime
from math import isfinite
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    AliasChoices,
    Discriminator,
    Field,
    Tag,
    create_model,
    field_validator,
    model_validator,
)

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import key
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.files.validation import Section
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import ADC_TOP_ADU, DetectorModel, Pixel, outside_window
from irlos_pipe.simulate.effects import EFFECTS, effects_of
from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import LENSLET_WINDOW, Sampling

FACILITY_KEYS = ("cutoff_per_m", "outer_scale_m")  # of the section `sky`
LARGEST_NM = 10_000.0


def require_nolls(values: dict[int, float]) -> dict[int, float]:
    """Return `values` by Noll index, all from 2 to 1000."""
    for noll in values:
        if not 2 <= noll <= 1000:
            raise ValueError(f"{noll} is no Noll index from 2 to 1000")
    return values


class EffectSection(Section):
    """Parameters of one effect."""

    @model_validator(mode="before")
    @classmethod
    def _single_value(cls, value: Any) -> Any:
        """Accept the list alone where an effect needs nothing else."""
        required = [name for name, field in cls.model_fields.items() if field.is_required()]
        return {required[0]: value} if isinstance(value, list) and len(required) == 1 else value

    @model_validator(mode="after")
    def _consistent(self) -> "EffectSection":
        name = type(self).__name__
        try:
            effects_of({name: self.model_dump(exclude_none=True)})
        except SceneError as problem:
            raise ValueError(str(problem).removeprefix(f"effects.{name}: ")) from None
        return self


def _section(effect: type[SimulatedEffect]) -> type[EffectSection]:
    """Return the form of the parameters of an `effect`; it is named like the effect."""
    public = {one.name: one for one in (*CATALOGUE[effect.name].public, *CATALOGUE[effect.name].options)}
    hints = get_type_hints(effect)
    keys: dict[str, Any] = {}
    for field in fields(effect):
        known, own = public.get(field.name), field.metadata
        limits = (own.get("ge", known and known.lower), own.get("le", known and known.upper))
        kind = known.kind if known and not own.get("description") else "number"
        names = [field.name, *filter(None, [own.get("formerly")])]
        keys[field.name] = (
            _type(hints[field.name], kind, *limits),
            Field(
                ... if field.default is MISSING else field.default,
                description=own.get("description") or (known.unit if known else ""),
                validation_alias=AliasChoices(*names) if len(names) > 1 else None,
            ),
        )
    return create_model(effect.name, __base__=EffectSection, __doc__=effect.__doc__, **keys)


def _type(hint: Any, kind: str, *limits: float | None) -> Any:
    """Return the type of a key of a `kind` for the `hint` of its field, with `limits` of numbers."""
    optional = NoneType in get_args(hint)
    hint = next(one for one in get_args(hint) if one is not NoneType) if optional else hint
    lowest, highest = (limit if limit is not None and isfinite(limit) else None for limit in limits)
    number = Annotated[float, Field(ge=lowest, le=highest)]
    if get_origin(hint) is Literal:
        key = hint
    elif kind == "parts":
        key = Annotated[list[number], Field(min_length=1)]
    elif kind == "zernike":
        key = Annotated[dict[int, number], AfterValidator(require_nolls)]
    elif kind == "pixels":
        key = Annotated[list[Pixel], Field(min_length=1)]
    else:
        key = list[number] if get_origin(hint) is Sequence else number
    return key | None if optional else key


_SECTIONS: dict[str, Any] = {name: (_section(effect) | None, None) for name, effect in EFFECTS.items()}
EffectKeys = create_model("EffectKeys", __base__=Section, **_SECTIONS)

BandName = Literal["narrow_h", "j", "h", "j_h"]
Nanometres = Annotated[float, Field(ge=-LARGEST_NM, le=LARGEST_NM)]
Zernikes = Annotated[dict[int, Nanometres], AfterValidator(require_nolls)]
Degrees = Annotated[float, Field(ge=-720, le=720)]


class AberrationKeys(Section):
    """Static aberrations: drawn by the NCPA law, or given."""

    total_nm: float | None = Field(None, ge=0, le=5000, description="RMS of the drawn modes together, nm")
    modes: int = Field(50, ge=2, le=500, description="number of drawn modes, from Noll 2 on")
    zernike_nm: Zernikes | None = Field(None, description="Noll index: nm RMS, instead of a draw")
    tail_nm: float = Field(0.0, ge=0, le=1000, description="RMS of every mode of a further, drawn tail")
    tail_nolls: tuple[int, int] = Field((52, 200), description="first and last Noll index of the tail")

    @model_validator(mode="after")
    def _consistent(self) -> "AberrationKeys":
        first, last = self.tail_nolls
        if not 2 <= first <= last <= 1000:
            raise ValueError("tail_nolls: give the first and the last Noll index, from 2 to 1000")
        if (self.total_nm is None) == (self.zernike_nm is None):
            raise ValueError("give either total_nm (drawn from the seed) or zernike_nm, Noll index: nm RMS")
        return self


class PupilKeys(Section):
    """The pupil as it is, where it differs from that of the instrument's profile, which nobody is told."""

    obscuration_m: float = Field(ge=0, description="diameter of the central hole")


class DiversityKeys(Section):
    """The aberration put in on purpose; the side-car states it."""

    source: str = Field("lens", min_length=1, description="what introduces it: lens or mirror")
    zernike: Zernikes = Field({6: -170.0}, description="Noll index: nm RMS")


FourNumbers = tuple[float, float, float, float]


class LensletKeys(Section):
    """Errors of the four lenslets: lower left, lower right, upper left, upper right."""

    x_mas: FourNumbers = Field((0.0,) * 4, description="displacement of their images along x")
    y_mas: FourNumbers = Field((0.0,) * 4, description="the same along y")
    flux: FourNumbers = Field((0.0,) * 4, description="light beyond their share, relative")

    @model_validator(mode="after")
    def _small(self) -> "LensletKeys":
        if max(map(abs, (*self.x_mas, *self.y_mas))) > 1000 or max(map(abs, self.flux)) > 0.9:
            raise ValueError("displacements are at most 1000 mas, and changes of the light at most 0.9")
        return self


@dataclass(frozen=True)
class SkyKeys(Sky):
    """AO residual, and what of the instrument's facility it changes."""

    cutoff_per_m: float | None = key(
        None, "1 / (2 actuator pitch); that of the instrument if left out", ge=0.2, le=1000
    )
    outer_scale_m: float | None = key(
        None, "outer scale of the turbulence; the instrument's if left out", ge=1, le=1000
    )

    def completed(self, facility: Facility) -> "SkyKeys":
        """Return the section with what it leaves out taken from the `facility`."""
        absent = [name for name in FACILITY_KEYS if getattr(self, name) is None]
        return replace(self, **{name: getattr(facility, name) for name in absent})

    @property
    def residual(self) -> Sky:
        return Sky(**{field.name: getattr(self, field.name) for field in fields(Sky)})


@dataclass(frozen=True)
class DetectorKeys(DetectorModel):
    """Detector constants of a recording, which is written in whole ADU."""

    saturation_adu: float = key(ADC_TOP_ADU, "end of the converter", gt=0, le=ADC_TOP_ADU)

    def __post_init__(self) -> None:
        _ = self.analogue_noise_e
        if self.pedestal_adu >= self.saturation_adu:
            raise SceneError("pedestal_adu must be below saturation_adu")


def _kind(value: Any) -> str:
    return "list" if isinstance(value, list) else "one"


# One value or a list of them; thanks to the tags a wrong one is reported once, not for each possibility.
Bands = Annotated[
    Annotated[BandName, Tag("one")] | Annotated[list[Band], Field(min_length=1, max_length=100), Tag("list")],
    Discriminator(_kind),
]
Defocus = Annotated[
    Annotated[Nanometres, Tag("one")] | Annotated[list[Nanometres], Tag("list")], Discriminator(_kind)
]
Role = Literal["ncpa_calibration", "defocus_ramp", "derotator", "psf"]
Side = Annotated[int, Field(ge=8, le=512)]
Mode = Literal[
    "64x64_FullPupil_200Hz_HighGain", "64x64_FullPupil_500Hz_HighGain", "20x20_SmallScale_500Hz_HighGain",
    "20x20_SmallScale_200Hz_HighGain", "20x20_SmallScale_500Hz_LowGain", "20x20_SmallScale_200Hz_LowGain",
    "20x20_LargeScale_500Hz_HighGain", "20x20_LargeScale_200Hz_HighGain", "20x20_LargeScale_500Hz_LowGain",
    "20x20_LargeScale_200Hz_LowGain",
]  # fmt: skip


class Shared(Section):
    """Sections that hold for all recordings; a recording may change them for itself."""

    ncpa: AberrationKeys | None = Field(None, description="static aberrations behind the derotator")
    rotating: AberrationKeys | None = Field(None, description="those before it, as they are at angle 0")
    diversity: DiversityKeys | None = Field(None, description="aberration put in on purpose")
    pupil: PupilKeys | None = Field(None, description="what of the pupil differs from the profile")
    sky: SkyKeys | None = Field(None, description="AO residual; left out on the bench")
    motion: Motion | None = Field(None, description="image motion; left out on the bench")
    detector: DetectorKeys | None = Field(None, description="detector constants")
    effects: EffectKeys | None = Field(None, description="effects that the side-car does not state")
    sampling: Sampling | None = Field(None, description="how finely the light is computed")


class RecordingKeys(Shared):
    """One recording; `offsets_nm` or `angles_deg` make a series of them, one per value."""

    role: Role = Field(description="what the recording is for")
    layout: Literal["recorder", "muse_raw"] = Field("recorder", description="of the files")
    mode: Mode = Field("64x64_FullPupil_200Hz_HighGain", description="mode string of a MUSE file")
    target: str = Field("SIMULATED", min_length=1, max_length=60, description="name of the star")
    mag_j: float = Field(ge=-5, le=25, description="J magnitude of the star")
    throughput: float | None = Field(None, gt=0, le=10, description="part of the J+H photons in the bands")
    bands: Bands = Field("narrow_h", description="narrow_h, j, h, j_h, or a list")
    frames: int = Field(ge=1, le=1_000_000, description="number of frames, of each recording of a series")
    exposure_s: float = Field(gt=0, le=600, description="exposure of a frame")
    frame_rate_hz: float | None = Field(None, gt=0, le=1000, description="frames per second; 1/exposure_s")
    sky_e_per_s: float | Literal["profile"] = Field(
        0.0, description="light of the sky in every pixel; profile: by the instrument's surface brightness"
    )
    window: tuple[Side, Side] = Field(
        (64, 64), description="[rows, columns]; in 2x2 modes of the four images without borders, [36, 36]"
    )
    lenslet_images: LensletKeys | None = Field(None, description="errors of the lenslets of a 2x2 mode")
    start: str | None = Field(
        None, pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d$", description="UTC of the first frame, ISO"
    )
    side_car: bool = Field(True, description="whether a side-car is written")
    pixel_scale_mas: float | None = Field(None, gt=1, le=500, description="of the instrument, if left out")
    pupil_rotation_deg: Degrees = Field(0.0, description="of the profile's pupil on the detector")
    derotator_angle_deg: Degrees = Field(0.0, description="angle of the derotator")
    introduced_nm: Defocus = Field(0.0, description="defocus, nm RMS; or per frame")
    offsets_nm: list[Nanometres] | None = Field(None, min_length=1, max_length=1000, description="of a ramp")
    order: Literal["as_given", "ping_pong"] = Field("as_given", description="in which the ramp is recorded")
    angles_deg: list[Degrees] | None = Field(None, min_length=1, max_length=1000, description="of a series")

    @model_validator(mode="before")
    @classmethod
    def _mapping(cls, value: Any) -> Any:
        if isinstance(value, dict) and str(value.get("mode", "")).startswith("20x20_"):
            return {"window": LENSLET_WINDOW, "layout": "muse_raw"} | value
        return value

    @property
    def lenslets(self) -> int:
        return 2 if self.mode.startswith("20x20_") else 1

    @field_validator("start", mode="before")
    @classmethod
    def _text(cls, value: Any) -> Any:
        """YAML makes a time of what looks like one, without quotes."""
        return value.isoformat() if isinstance(value, datetime) else value

    @field_validator("start")
    @classmethod
    def _a_date(cls, value: str | None) -> str | None:
        if value is not None:
            datetime.fromisoformat(value)  # its message says what is wrong
        return value

    @property
    def hidden(self) -> dict[str, Mapping[str, Any]]:
        """Parameters of the effects that are switched on, by name."""
        sections = dict(self.effects or {})
        return {name: its.model_dump(exclude_none=True) for name, its in sections.items() if its is not None}

    @model_validator(mode="after")
    def _consistent(self) -> "RecordingKeys":
        problem = next(self._problems(), None)
        if problem:
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        """What contradicts each other."""
        if self.offsets_nm and self.angles_deg:
            yield "give offsets_nm (a ramp) or angles_deg (a derotator series), not both"
        if self.offsets_nm and self.role != "defocus_ramp":
            yield f"offsets_nm makes a ramp, but the role is {self.role}; set role: defocus_ramp"
        if self.offsets_nm and self.introduced_nm != 0:
            yield "give offsets_nm or introduced_nm, not both"
        if isinstance(self.introduced_nm, list) and len(self.introduced_nm) != self.frames:
            given = len(self.introduced_nm)
            yield f"introduced_nm has {given} values for {self.frames} frames; give one per frame"
        if self.frame_rate_hz and self.exposure_s * self.frame_rate_hz > 1 + 1e-9:
            yield (
                f"exposure_s = {self.exposure_s:g} is longer than the {1 / self.frame_rate_hz:g} s that "
                f"frame_rate_hz = {self.frame_rate_hz:g} leaves for a frame; lower one of them"
            )
        if self.layout == "muse_raw" and (self.offsets_nm or self.angles_deg):
            yield "layout: muse_raw holds one cube; use layout: recorder for a series"
        if self.lenslets > 1 and self.layout != "muse_raw":
            yield f"mode {self.mode} is one of MUSE raw files; use layout: muse_raw"
        if self.lenslets > 1 and any(size % 2 for size in self.window):
            yield f"window {list(self.window)} has no four equal images; give even numbers"
        if self.lenslets == 1 and self.lenslet_images:
            yield f"lenslet_images: mode {self.mode} has no lenslets"
        if self.detector is not None:
            hot = [hot.pixel for hot in self.detector.hot_e_per_s]
            for name, pixels in (("detector.dead", self.detector.dead), ("detector.hot", hot)):
                yield from filter(None, [outside_window(name, pixels, self.window)])
        if not isinstance(self.sky_e_per_s, str) and not 0 <= self.sky_e_per_s <= 1e6:
            yield f"sky_e_per_s = {self.sky_e_per_s:g} should be from 0 to 1e6"

    def completed(self, facility: Facility) -> "RecordingKeys":
        """Return this recording with what sky and motion leave out taken from the `facility`."""
        known: dict[str, Any] = {"sky": self.sky and self.sky.completed(facility)}
        if self.motion is not None and self.motion.lines is None:
            known["motion"] = replace(self.motion, lines=facility.vibration_lines)
        return self.model_copy(update=known)
