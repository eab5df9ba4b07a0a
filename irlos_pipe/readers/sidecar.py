"""The side-car ``acquisition.yaml``: what the data themselves cannot say."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.files.validation import Origins, require_valid
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.readers.fitsfile import stem

FOLDER_SIDECAR = "acquisition.yaml"
MAX_WAVELENGTH_RATIO = 3.0
Role = Literal["ncpa_calibration", "defocus_ramp", "derotator", "psf", "dark"]


class _Section(BaseModel):
    model_config = ConfigDict(
        defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True
    )

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_no_truth_values(cls, values: Any) -> Any:
        """Refuse ``true`` where a number is wanted, which would count as 1."""
        if isinstance(values, dict):
            for key, value in values.items():
                field = cls.model_fields.get(str(key))
                if isinstance(value, bool) and field is not None and "bool" not in str(field.annotation):
                    raise ValueError(f"{key} is {str(value).lower()}, which is no number; give its value")
        return values


class SpectrumPoint(_Section):
    """One wavelength with its photon weight."""

    wavelength_nm: float = Field(ge=100, le=30000, description="wavelength in nm")
    weight: float = Field(1.0, ge=0, description="photons, any scale")


class DiversityKeys(_Section):
    """The aberration put in on purpose."""

    source: str = Field("lens", min_length=1, description="what introduces it, for example lens")
    zernike: dict[int, float] = Field(description="Noll index: nm RMS")

    @model_validator(mode="after")
    def _sensible(self) -> DiversityKeys:
        for noll, nm in self.zernike.items():
            if not 2 <= noll <= 1000:
                raise ValueError(f"zernike: {noll} is no Noll index from 2 to 1000")
            if abs(nm) > 10000:
                raise ValueError(f"zernike: {nm} nm RMS for Noll {noll} is beyond 10000 nm")
        return self


class DetectorKeys(_Section):
    """Detector constants."""

    e_per_adu: float | None = Field(None, gt=0, le=1e5, description="photo-electrons per ADU")
    read_noise_e: float | None = Field(
        None, ge=0, le=1e5, description="RMS per pixel and read in e-, rounding included"
    )
    excess_noise_factor: float | None = Field(None, ge=1, le=10, description="photon variance over Poisson's")
    saturation_adu: float | None = Field(None, gt=0, description="raw level that counts as saturated")
    coadds: int | None = Field(None, ge=1, le=10**6, description="reads in a frame")
    coadds_averaged: bool | None = Field(None, description="mean of the reads, not their sum")
    read_s: float | None = Field(None, gt=0, le=3600, description="exposure of a read in seconds")
    dark_e_per_s: float | None = Field(None, ge=0, le=1e8, description="dark current per pixel in e-/s")


class AcquisitionKeys(_Section):
    """Every key of the side-car. All may be left out here; `acquisition.resolve` knows what is required."""

    role: Role | None = Field(None, description="what the recording is for")
    target: str | None = Field(None, description="name of the star")
    mag_j: float | None = Field(None, ge=-5, le=30, description="J magnitude")
    exposure_s: float | None = Field(None, gt=0, le=3600, description="exposure of a frame in seconds")
    frame_rate_hz: float | None = Field(None, gt=0, le=1e5, description="recorded frames per second")
    pixel_scale_mas: float | None = Field(None, gt=0, le=10000, description="mas per pixel")
    seeing_arcsec: float | None = Field(None, gt=0, le=10, description="seeing, on SPARTA's scale or another")
    seeing_scale: str | None = Field(None, min_length=1, description="who measured it, for example mass_dimm")
    spectrum: list[SpectrumPoint] | None = Field(
        None, min_length=1, max_length=100, description="wavelengths with weights"
    )
    diversity: DiversityKeys | None = Field(None, description="aberration introduced on purpose")
    introduced_defocus_nm: float | list[float] | None = Field(
        None, description="nm RMS, one or one per frame"
    )
    derotator_angle_deg: float | None = Field(None, ge=-720, le=720, description="angle of the derotator")
    parallactic_angle_deg: float | None = Field(None, ge=-360, le=360, description="parallactic angle")
    pupil_rotation_deg: float | None = Field(
        None, ge=-720, le=720, description="of the pupil on the detector, anticlockwise from the profile's"
    )
    altitude_deg: float | None = Field(None, ge=0, le=90, description="altitude of the telescope")
    airmass: float | None = Field(None, ge=1, le=40, description="1 / sin(altitude), instead of it")
    zenith_angle_deg: float | None = Field(
        None, ge=-720, le=720, description="direction of the zenith in the image, from +x towards +y"
    )
    pressure_hpa: float | None = Field(None, gt=0, le=1100, description="air pressure at the telescope")
    temperature_c: float | None = Field(None, ge=-90, le=60, description="its temperature")
    humidity_percent: float | None = Field(None, ge=0, le=100, description="its relative humidity")
    dispersion_corrected: bool | None = Field(None, description="a corrector takes out the atmosphere's")
    sky_e_per_s: float | None = Field(None, ge=0, le=1e8, description="light of the sky per pixel in e-/s")
    filter: str | None = Field(None, min_length=1, description="name of the filter")
    filter_curve: list[tuple[float, float]] | None = Field(
        None, min_length=3, description="[wavelength in nm, transmission], …; instead of spectrum"
    )
    star_temperature_k: float | None = Field(
        None, ge=1000, le=50000, description="of the star, with the curve"
    )
    j_minus_h: float | None = Field(None, ge=-5, le=20, description="colour of the star, instead of it")
    mode: str | None = Field(
        None, min_length=1, description="read-out mode of a MUSE raw file whose header lacks it"
    )
    detector: DetectorKeys | None = Field(None, description="detector constants")

    @model_validator(mode="after")
    def _has_light(self) -> AcquisitionKeys:
        if self.spectrum is not None and not any(point.weight > 0 for point in self.spectrum):
            raise ValueError("spectrum: at least one weight must be positive")
        return self

    @model_validator(mode="after")
    def _one_band(self) -> AcquisitionKeys:
        """A wide band needs a wide field in memory; nobody images three octaves at once."""
        lit = [point.wavelength_nm for point in self.spectrum or () if point.weight > 0]
        if lit and max(lit) > MAX_WAVELENGTH_RATIO * min(lit):
            raise ValueError(
                f"spectrum: from {min(lit):g} to {max(lit):g} nm; the longest wavelength may be "
                f"{MAX_WAVELENGTH_RATIO:g} times the shortest"
            )
        return self

    def updated(self, other: AcquisitionKeys) -> AcquisitionKeys:
        """Return these keys with those that `other` gives replaced."""
        own, new = (keys.model_dump(exclude_none=True) for keys in (self, other))
        detector = own.get("detector", {}) | new.get("detector", {})
        return AcquisitionKeys.model_validate(own | new | ({"detector": detector} if detector else {}))

    def flat(self) -> dict[str, Any]:
        """Return the keys that were given, those of the detector dotted (``detector.e_per_adu``)."""
        fields = type(self).model_fields  # in the order of the class: that of a set differs between processes
        given = {key: getattr(self, key) for key in fields if getattr(self, key) is not None}
        detector = given.pop("detector", None)
        inner = {} if detector is None else detector.model_dump(exclude_none=True)
        return given | {f"detector.{key}": value for key, value in inner.items()}


def own_sidecar(data_file: Path) -> Path:
    """Return where the side-car of a data file would be that is its alone: ``<stem>.yaml``."""
    return data_file.with_name(f"{stem(data_file)}.yaml")


def sidecar_path(data_file: Path) -> Path:
    """Return where the side-car of a data file is, or would be.

    ``<stem>.yaml`` beside the file if there is one, else ``acquisition.yaml`` in its folder.
    """
    own = own_sidecar(data_file)
    return own if own.is_file() else data_file.with_name(FOLDER_SIDECAR)


def read_sidecar(path: Path) -> AcquisitionKeys:
    """Read and check a side-car; one that does not exist has no keys.

    Raises
    ------
    InputDataError
        One line ``file:line: problem``, and how many more problems there are.
    """
    try:
        return _read(path)
    except ConfigurationError as error:
        raise InputDataError(_one_line(str(error))) from None


def sidecar_problems(path: Path) -> list[str]:
    """Return a line ``file:line: problem`` for everything that is wrong with a side-car."""
    try:
        _read(path)
    except (ConfigurationError, InputDataError) as error:
        return str(error).splitlines()
    return []


def _read(path: Path) -> AcquisitionKeys:
    if not path.exists():
        return AcquisitionKeys()
    data, lines = load_yaml(path, InputDataError)
    return require_valid(data, AcquisitionKeys, Origins(path, lines))


def _one_line(text: str) -> str:
    """Return the most helpful line, and how many others there are."""
    lines = text.splitlines()
    # a key that is misspelt is missing as well; the suggestion says more
    best = min(lines, key=lambda line: "did you mean" not in line)
    return best + and_more(lines)
