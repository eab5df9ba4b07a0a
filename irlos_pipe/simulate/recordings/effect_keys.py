"""The effects of the catalogue and their parameters: what acts on the data and the side-car does not tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from irlos_pipe.simulate.recordings.keys import (
    Degrees,
    Nanometres,
    Pixel,
    Relative,
    RelativeZernikes,
    Section,
    Zernikes,
)

Petals = Annotated[list[Nanometres], Field(min_length=4, max_length=4)]
Factor = Annotated[float, Field(ge=0, le=1000)]
NO_PETALS = [0.0, 0.0, 0.0, 0.0]


class Jitter(Section):
    """Isotropic image motion within an exposure."""

    sigma_mas: float = Field(ge=0, le=200, description="RMS per axis")
    correlation_s: float | None = Field(None, gt=0, le=10, description="time after which it has moved on")


class Vibration(Section):
    """Motion along one direction."""

    sigma_mas: float = Field(ge=0, le=200, description="RMS along the direction")
    angle_deg: Degrees = Field(0.0, description="from +x towards +y")
    frequency_hz: float | None = Field(None, gt=0, le=1000, description="48.3 Hz if left out")
    distribution: Literal["sinusoidal", "gaussian"] = Field("sinusoidal", description="of the positions")


class Halo(Section):
    """A further AO residual."""

    scale: float | None = Field(None, ge=0, le=10, description="factor on the residual of the sky")
    wfe_nm: float | None = Field(None, ge=0, le=1000, description="total residual instead, nm RMS")

    @model_validator(mode="after")
    def _one(self) -> Halo:
        if (self.scale is None) == (self.wfe_nm is None):
            raise ValueError("give either scale or wfe_nm")
        return self


class Dispersion(Section):
    """Residual chromatic elongation."""

    mas_per_um: float = Field(ge=-5000, le=5000, description="image shift per micrometre of wavelength")
    angle_deg: Degrees = Field(0.0, description="from +x towards +y")


class SpectrumError(Section):
    """The true spectrum against the one in the side-car."""

    wavelength_nm: float = Field(0.0, ge=-300, le=300, description="shift of all wavelengths")
    slope: float = Field(0.0, ge=-20, le=20, description="colour: relative change of the weight per um")
    weights: list[Factor] | None = Field(None, description="factor on the photons of each band")


class Fraction(Section):
    """A relative error."""

    fraction: Relative = Field(description="relative error")


class Amplitude(Section):
    """An error of an amplitude."""

    nm: Nanometres = Field(description="nm RMS")


class PupilShift(Section):
    """An internal stop against the telescope pupil."""

    dx_m: float = Field(0.0, ge=-2, le=2, description="displacement along x")
    dy_m: float = Field(0.0, ge=-2, le=2, description="displacement along y")
    rotation_deg: Degrees = Field(0.0, description="rotation of the vanes")


class Transmission(Section):
    """Smooth non-uniform transmission."""

    zernike: RelativeZernikes = Field(description="Noll index: relative amplitude")


class Petal(Section):
    """Piston, tip and tilt of the petals, anticlockwise from the one on the +45 deg diagonal."""

    piston_nm: Petals = Field(NO_PETALS, description="one per petal")
    tip_nm: Petals = Field(NO_PETALS, description="one per petal")
    tilt_nm: Petals = Field(NO_PETALS, description="one per petal")


class ZernikeTerms(Section):
    """Modes by their Noll index."""

    zernike_nm: Zernikes = Field(description="Noll index: nm RMS")


class Bump(Section):
    """Localised OPD in the pupil."""

    nm: Nanometres = Field(description="height")
    x_m: float = Field(ge=-10, le=10, description="position")
    y_m: float = Field(ge=-10, le=10, description="position")
    width_m: float = Field(gt=0, le=10, description="width (sigma)")


class Companion(Section):
    """A second source of the same spectrum."""

    flux_ratio: float = Field(ge=0, le=1, description="secondary over primary")
    sep_mas: float = Field(ge=0, le=2000, description="separation")
    pa_deg: Degrees = Field(description="from +x towards +y")


class Crosstalk(Section):
    """Charge shared with the four neighbours."""

    fraction: float = Field(ge=0, le=0.5, description="of the charge, all neighbours together")


class Nonlinearity(Section):
    """Response s (1 - f s / s_peak)."""

    fraction_at_peak: float = Field(ge=0, le=0.5, description="f, at the peak of the mean image")


class Background(Section):
    """Pedestal or gradient left in the images."""

    e_per_pixel: float = Field(0.0, ge=-1e5, le=1e5, description="slope, e- per frame and pixel")
    angle_deg: Degrees = Field(0.0, description="from +x towards +y")
    level_e: float = Field(0.0, ge=-1e6, le=1e6, description="level at the centre, e- per frame")


class BadPixels(Section):
    """Pixels that went bad after the dark and the map of dead pixels were taken."""

    pixels: list[Pixel] = Field(min_length=1, description="list of [row, column]")
    kind: Literal["hot", "dead", "stuck"] = Field("hot", description="what they do")
    level_e: float = Field(1000.0, ge=0, le=1e6, description="of hot and stuck pixels, e- per frame")

    @model_validator(mode="before")
    @classmethod
    def _plain_list(cls, value: Any) -> Any:
        return {"pixels": value} if isinstance(value, list) else value


class Hysteresis(Section):
    """Introduced defocus biased by the direction of travel."""

    nm: Nanometres = Field(description="bias after moving towards larger offsets; its opposite otherwise")
    scatter_nm: float = Field(0.0, ge=0, le=5000, description="drawn anew for every move, RMS")


class StageOffset(Section):
    """Constant bias of a ramp, or of a part of it."""

    nm: Nanometres = Field(description="bias")
    above_nm: float | None = Field(None, description="only offsets larger than this")
    below_nm: float | None = Field(None, description="only offsets smaller than this")


class EffectKeys(Section):
    """The catalogue."""

    tip_tilt_jitter: Jitter | None = None
    vibration: Vibration | None = None
    seeing_halo: Halo | None = None
    atmospheric_dispersion: Dispersion | None = None
    spectrum: SpectrumError | None = None
    plate_scale: Fraction | None = None
    diversity_error: Amplitude | None = None
    pupil_misregistration: PupilShift | None = None
    amplitude_aberration: Transmission | None = None
    low_wind_effect: Petal | None = None
    high_order_ncpa: ZernikeTerms | None = None
    phase_bump: Bump | None = None
    ncpa_drift: ZernikeTerms | None = None
    companion: Companion | None = None
    interpixel_crosstalk: Crosstalk | None = None
    detector_nonlinearity: Nonlinearity | None = None
    background_gradient: Background | None = None
    bad_pixels: BadPixels | None = None
    focus_stage_hysteresis: Hysteresis | None = None
    focus_stage_offset: StageOffset | None = None
    focus_stage_scale: Fraction | None = None

    def given(self) -> dict[str, Mapping[str, Any]]:
        """Parameters of the effects that are switched on, by name."""
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        return {
            name: section.model_dump(exclude_none=True)
            for name, section in sections.items()
            if section is not None
        }
