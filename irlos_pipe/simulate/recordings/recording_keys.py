"""The keys of a simulation spec for one recording, or one series of them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.reads import whole_reads
from irlos_pipe.simulate.detector import outside_window
from irlos_pipe.simulate.effects.base import RecordingSetup
from irlos_pipe.simulate.effects.catalogue import effects_of
from irlos_pipe.simulate.recordings.effect_keys import EffectKeys
from irlos_pipe.simulate.recordings.section_keys import (
    AberrationKeys,
    BandKeys,
    BandName,
    Degrees,
    DetectorKeys,
    DiversityKeys,
    LensletKeys,
    MotionKeys,
    Nanometres,
    PupilKeys,
    SamplingKeys,
    Section,
    SkyKeys,
)
from irlos_pipe.simulate.scene import LENSLET_WINDOW


def _kind(value: Any) -> str:
    return "list" if isinstance(value, list) else "one"


# One value or a list of them; thanks to the tags a wrong one is reported once, not for each possibility.
Bands = Annotated[
    Annotated[BandName, Tag("one")]
    | Annotated[list[BandKeys], Field(min_length=1, max_length=100), Tag("list")],
    Discriminator(_kind),
]
Defocus = Annotated[
    Annotated[Nanometres, Tag("one")] | Annotated[list[Nanometres], Tag("list")], Discriminator(_kind)
]
Role = Literal["ncpa_calibration", "defocus_ramp", "derotator", "psf"]
Side = Annotated[int, Field(ge=8, le=512)]
Mode = Literal[
    "64x64_FullPupil_200Hz_HighGain",
    "64x64_FullPupil_500Hz_HighGain",
    "20x20_SmallScale_500Hz_HighGain",
    "20x20_SmallScale_200Hz_HighGain",
    "20x20_SmallScale_500Hz_LowGain",
    "20x20_SmallScale_200Hz_LowGain",
    "20x20_LargeScale_500Hz_HighGain",
    "20x20_LargeScale_200Hz_HighGain",
    "20x20_LargeScale_500Hz_LowGain",
    "20x20_LargeScale_200Hz_LowGain",
]


class Shared(Section):
    """Sections that hold for all recordings; a recording may change them for itself."""

    ncpa: AberrationKeys | None = Field(None, description="static aberrations behind the derotator")
    rotating: AberrationKeys | None = Field(None, description="those before it, as they are at angle 0")
    diversity: DiversityKeys | None = Field(None, description="aberration put in on purpose")
    pupil: PupilKeys | None = Field(None, description="what of the pupil differs from the profile")
    sky: SkyKeys | None = Field(None, description="AO residual; left out on the bench")
    motion: MotionKeys | None = Field(None, description="image motion; left out on the bench")
    detector: DetectorKeys | None = Field(None, description="detector constants")
    effects: EffectKeys | None = Field(None, description="effects that the side-car does not state")
    sampling: SamplingKeys | None = Field(None, description="how finely the light is computed")


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
        if not isinstance(value, dict):
            raise ValueError("should be a section of 'key: value' lines")
        if str(value.get("mode", "")).startswith("20x20_"):
            return {"window": LENSLET_WINDOW, "layout": "muse_raw"} | value
        return value

    @property
    def lenslets(self) -> int:
        """Lenslets per side of the pupil."""
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

    @model_validator(mode="after")
    def _consistent(self) -> RecordingKeys:
        found = (
            self._series_problem(),
            self._time_problem(),
            self._layout_problem(),
            self._pixel_problem(),
            self._reads_problem(),
            self._sky_problem(),
        )
        if any(found):
            raise ValueError(next(filter(None, found)))
        return self

    def _series_problem(self) -> str:
        if self.offsets_nm and self.angles_deg:
            return "give offsets_nm (a ramp) or angles_deg (a derotator series), not both"
        if self.offsets_nm and self.role != "defocus_ramp":
            return f"offsets_nm makes a ramp, but the role is {self.role}; set role: defocus_ramp"
        if self.offsets_nm and self.introduced_nm != 0:
            return "give offsets_nm or introduced_nm, not both"
        per_frame = self.introduced_nm if isinstance(self.introduced_nm, list) else None
        if per_frame is not None and len(per_frame) != self.frames:
            return f"introduced_nm has {len(per_frame)} values for {self.frames} frames; give one per frame"
        return ""

    def _time_problem(self) -> str:
        if self.frame_rate_hz and self.exposure_s * self.frame_rate_hz > 1 + 1e-9:
            return (
                f"exposure_s = {self.exposure_s:g} is longer than the {1 / self.frame_rate_hz:g} s that "
                f"frame_rate_hz = {self.frame_rate_hz:g} leaves for a frame; lower one of them"
            )
        return ""

    def _reads_problem(self) -> str:
        """Say that reads do not fill the exposure; the detector may be shared, so asked when it is in."""
        if self.detector is None or self.detector.read_s is None:
            return ""
        try:
            whole_reads(self.exposure_s, self.detector.read_s)
        except ConfigurationError as problem:
            return f"detector.read_s: {problem}"
        return ""

    def _layout_problem(self) -> str:
        if self.layout == "muse_raw" and (self.offsets_nm or self.angles_deg):
            return "layout: muse_raw holds one cube; use layout: recorder for a series"
        if self.lenslets > 1 and self.layout != "muse_raw":
            return f"mode {self.mode} is one of MUSE raw files; use layout: muse_raw"
        if self.lenslets > 1 and any(size % 2 for size in self.window):
            return f"window {list(self.window)} has no four equal images; give even numbers"
        if self.lenslets == 1 and self.lenslet_images:
            return f"lenslet_images: mode {self.mode} has no lenslets"
        return ""

    def _sky_problem(self) -> str:
        if isinstance(self.sky_e_per_s, str) or 0 <= self.sky_e_per_s <= 1e6:
            return ""
        return f"sky_e_per_s = {self.sky_e_per_s:g} should be from 0 to 1e6"

    def _pixel_problem(self) -> str:
        """Say which pixel of the detector lies outside the window; empty if none does."""
        if self.detector is None:
            return ""
        named = {
            "detector.dead": self.detector.dead,
            "detector.hot": [hot.pixel for hot in self.detector.hot],
        }
        return next(filter(None, (outside_window(key, own, self.window) for key, own in named.items())), "")

    def with_shared(self, shared: Shared) -> RecordingKeys:
        """Return this recording with the shared sections filled in below its own."""
        merged = {name: self._merged(name, shared) for name in Shared.model_fields}
        own = {name: getattr(self, name) for name in self.model_fields_set}
        return RecordingKeys.model_validate({**own, **{k: v for k, v in merged.items() if v is not None}})

    def completed(self, facility: Facility) -> RecordingKeys:
        """Return this recording with what sky and motion leave out taken from the `facility`."""
        sections = {"sky": self.sky, "motion": self.motion}
        known = {name: section.completed(facility) for name, section in sections.items() if section}
        return self.model_copy(update=known)

    def misfit(self, geometry: PupilGeometry) -> str:
        """Say which effect does not fit the recording or the pupil; asked when the shared sections are in."""
        bands = {"j_h": 2}.get(self.bands, 1) if isinstance(self.bands, str) else len(self.bands)
        diversity_nm = self.diversity.zernike if self.diversity else {}
        setup = RecordingSetup(geometry, bands, self.window, diversity_nm)
        effects = effects_of(self.effects.given() if self.effects else {})
        return next(filter(None, (effect.misfit(setup) for effect in effects)), "")

    def _merged(self, name: str, shared: Shared) -> Section | None:
        """A section given here goes over the shared one; given as null, it switches that one off."""
        own, below = getattr(self, name), getattr(shared, name)
        if name not in self.model_fields_set:
            return below
        # aberrations are one thing: half of a draw and half of a list make no sense
        return own if own is None or isinstance(own, AberrationKeys) else own.over(below)
