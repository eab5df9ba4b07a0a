"""Sections of a simulation spec: aberrations, sky, motion, detector, sampling. Units are in the keys."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.simulate.atmosphere import Shape, Sky
from irlos_pipe.simulate.detector import ADC_TOP_ADU, DetectorModel
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import Sampling

LARGEST_NM = 10_000.0
FACILITY_KEYS = ("cutoff_per_m", "outer_scale_m")  # of the section `sky`
BandName = Literal["narrow_h", "j", "h", "j_h"]


class Section(BaseModel):
    """Base of all sections: unknown keys and values that are not finite are refused."""

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)

    def over(self, below: Section | None) -> Section:
        """Return `below` with the keys that were given here replaced."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return type(self).model_validate({**({} if below is None else dict(below)), **given})


def require_nolls(values: dict[int, float]) -> dict[int, float]:
    """Return `values` by Noll index, all from 2 to 1000."""
    for noll in values:
        if not 2 <= noll <= 1000:
            raise ValueError(f"{noll} is no Noll index from 2 to 1000")
    return values


Nanometres = Annotated[float, Field(ge=-LARGEST_NM, le=LARGEST_NM)]
Zernikes = Annotated[dict[int, Nanometres], AfterValidator(require_nolls)]
Index = Annotated[int, Field(ge=0, lt=4096)]
Pixel = tuple[Index, Index]
Degrees = Annotated[float, Field(ge=-720, le=720)]


class AberrationKeys(Section):
    """Static aberrations: drawn by the NCPA law, or given."""

    total_nm: float | None = Field(None, ge=0, le=5000, description="RMS of the drawn modes together, nm")
    modes: int = Field(50, ge=2, le=500, description="number of drawn modes, from Noll 2 on")
    zernike_nm: Zernikes | None = Field(None, description="Noll index: nm RMS, instead of a draw")
    tail_nm: float = Field(0.0, ge=0, le=1000, description="RMS of every mode of a further, drawn tail")
    tail_nolls: tuple[int, int] = Field((52, 200), description="first and last Noll index of the tail")

    @model_validator(mode="after")
    def _tail(self) -> AberrationKeys:
        first, last = self.tail_nolls
        if not 2 <= first <= last <= 1000:
            raise ValueError("tail_nolls: give the first and the last Noll index, from 2 to 1000")
        return self

    @model_validator(mode="after")
    def _one_way(self) -> AberrationKeys:
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
    def _small(self) -> LensletKeys:
        if max(map(abs, (*self.x_mas, *self.y_mas))) > 1000 or max(map(abs, self.flux)) > 0.9:
            raise ValueError("displacements are at most 1000 mas, and changes of the light at most 0.9")
        return self

    @property
    def tilts_mas(self) -> tuple[tuple[float, float], ...]:
        """Displacements (x, y) of the images."""
        return tuple(zip(self.x_mas, self.y_mas, strict=True))


class SkyKeys(Section):
    """AO residual; its size follows the seeing unless wfe_nm is given."""

    seeing_arcsec: float = Field(0.5, ge=0.1, le=4, description="at 500 nm, on SPARTA's scale")
    wfe_nm: float | None = Field(None, ge=0, le=1000, description="total residual, nm RMS")
    shape: Shape = Field(Sky.shape, description="of the spectrum inside the correction band")
    slope: float = Field(Sky.slope, ge=0, le=6, description="the power law falls like f**-slope")
    wind_m_s: float = Field(Sky.wind_m_s, ge=0, le=100, description="wind speed")
    wind_angle_deg: Degrees = Field(Sky.wind_angle_deg, description="from +x towards +y")
    cutoff_per_m: float | None = Field(
        None, ge=0.2, le=1000, description="1 / (2 actuator pitch); that of the instrument if left out"
    )
    outer_scale_m: float | None = Field(
        None, ge=1, le=1000, description="outer scale of the turbulence; the instrument's if left out"
    )
    delay_s: float = Field(Sky.delay_s, gt=0, le=1, description="of the loop; sets the servo lag")
    drift_rms: float = Field(
        Sky.drift_rms, ge=0, le=1, description="relative, of the size in shape non_stationary"
    )
    drift_s: float = Field(Sky.drift_s, gt=0, le=1e4, description="correlation time of that drift")

    def completed(self, facility: Facility) -> SkyKeys:
        """Return the section with what it leaves out taken from the `facility`."""
        absent = [name for name in FACILITY_KEYS if getattr(self, name) is None]
        return self.model_copy(update={name: getattr(facility, name) for name in absent})

    @model_validator(mode="after")
    def _wind(self) -> SkyKeys:
        if self.wind_m_s == 0 and self.shape in ("servo_lag", "aliasing"):
            raise ValueError(f"shape {self.shape} needs wind; give wind_m_s above 0")
        return self


class VibrationLine(Section):
    """One vibration of the telescope."""

    hz: float = Field(gt=0, le=400, description="frequency")
    share_x: float = Field(ge=0, le=1, description="part of the variance along x")
    share_y: float = Field(ge=0, le=1, description="part of the variance along y")


class MotionKeys(Section):
    """Residual image motion; the lines are those of UT4 unless given."""

    rms_mas: float = Field(Motion.rms_mas, ge=0, le=200, description="per axis")
    wander_hz: float = Field(
        Motion.wander_hz, gt=0, le=200, description="corner frequency of the slow wander"
    )
    line_coherence_s: float = Field(
        Motion.line_coherence_s, gt=0, le=1e4, description="time over which a line keeps its phase"
    )
    lines: list[VibrationLine] | None = Field(None, description="vibrations: {hz, share_x, share_y}")

    def completed(self, facility: Facility) -> MotionKeys:
        """Return the section with what it leaves out taken from the `facility`."""
        if self.lines is not None:
            return self
        lines = [VibrationLine(hz=hz, share_x=x, share_y=y) for hz, x, y in facility.vibration_lines]
        return self.model_copy(update={"lines": lines})

    @model_validator(mode="after")
    def _shares(self) -> MotionKeys:
        for axis in ("share_x", "share_y"):
            total = sum(getattr(line, axis) for line in self.lines or ())
            if total > 1:
                raise ValueError(f"lines: the values of {axis} add up to {total:g}, more than 1")
        return self


class HotPixel(Section):
    """A pixel with a dark current of its own."""

    pixel: Pixel = Field(description="[row, column]")
    e_per_s: float = Field(ge=0, le=1e9, description="dark current")


class DetectorKeys(Section):
    """Detector constants; the defaults are benign."""

    e_per_adu: float = Field(DetectorModel.e_per_adu, gt=0, le=1000, description="photo-electrons per ADU")
    read_noise_e: float = Field(
        DetectorModel.read_noise_e, ge=0, le=1000, description="RMS per pixel and read, rounding included"
    )
    pedestal_adu: float = Field(DetectorModel.pedestal_adu, ge=0, le=60000, description="level without light")
    fixed_pattern_adu: float = Field(
        DetectorModel.fixed_pattern_adu, ge=0, le=5000, description="scatter of the level between pixels"
    )
    excess_noise_factor: float = Field(
        DetectorModel.excess_noise_factor, ge=1, le=5, description="photon variance over Poisson's"
    )
    flat_rms: float = Field(
        DetectorModel.flat_rms, ge=0, le=0.5, description="scatter of the gain between pixels, relative"
    )
    flat_error_rms: float = Field(
        DetectorModel.flat_error_rms, ge=0, le=0.5, description="scatter of the gain that no flat shows"
    )
    dark_e_per_s: float = Field(
        DetectorModel.dark_e_per_s, ge=0, le=1e6, description="dark current of every pixel"
    )
    dead: list[Pixel] = Field([], description="[row, column] of pixels that the map of dead pixels shows")
    hot: list[HotPixel] = Field([], description="pixels that the dark shows: {pixel, e_per_s}")
    crosstalk_fraction: float = Field(
        DetectorModel.crosstalk_fraction, ge=0, le=0.5, description="charge diffusing to the 4 neighbours"
    )
    coupling_fraction: float = Field(
        DetectorModel.coupling_fraction, ge=0, le=0.5, description="signal induced in the 4 neighbours"
    )
    nonlinearity_per_e: float = Field(
        DetectorModel.nonlinearity_per_e, ge=0, le=1e-3, description="k of the response s (1 - k s)"
    )
    full_well_e: float | None = Field(None, gt=0, description="signal at which a pixel stops collecting")
    saturation_adu: float = Field(ADC_TOP_ADU, gt=0, le=ADC_TOP_ADU, description="end of the converter")
    read_s: float | None = Field(
        None,
        gt=0,
        le=600,
        description="exposure of a read, of which a frame is the sum; one read if left out",
    )
    pattern_seed: int = Field(
        DetectorModel.pattern_seed, ge=0, description="seed of what is fixed in the detector"
    )

    @model_validator(mode="after")
    def _consistent(self) -> DetectorKeys:
        rounding_e = self.e_per_adu / 12**0.5
        if self.read_noise_e < rounding_e:
            raise ValueError(
                f"read_noise_e = {self.read_noise_e:g} is below the noise of rounding to whole ADU, "
                f"e_per_adu/sqrt(12) = {rounding_e:.3g} e-; raise it, or lower e_per_adu"
            )
        if self.pedestal_adu >= self.saturation_adu:
            raise ValueError("pedestal_adu must be below saturation_adu")
        return self


class SamplingKeys(Section):
    """Fineness of the computation; for tests and for checks of the accuracy."""

    pupil_samples: int | None = Field(None, ge=32, le=1024, description="across the diameter")
    points_per_band: int = Field(Sampling.points_per_band, ge=1, le=41, description="wavelengths per band")
    step_s: float = Field(
        Sampling.step_s, ge=1e-4, le=10, description="longest time between instantaneous images"
    )


class BandKeys(Section):
    """A flat pass-band."""

    centre_nm: float = Field(ge=500, le=5000, description="centre")
    half_width_nm: float = Field(ge=0, le=1000, description="half its width")
    share: float = Field(1.0, gt=0, le=1e6, description="photons, any scale")

    @model_validator(mode="after")
    def _positive(self) -> BandKeys:
        if self.half_width_nm > self.centre_nm / 2:
            raise ValueError("half_width_nm is more than half of centre_nm")
        return self
