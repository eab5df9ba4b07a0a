"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

import math
from dataclasses import dataclass
from math import nan
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.calibration_options import (
    DEFAULT_METHOD,
    METHODS,
    OPEN,
    CalibrationOptions,
    Cause,
    MethodName,
    NcpaPrior,
    OneSetup,
    OptimiserName,
    TwinCheck,
)
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import (
    DITTO,
    ByNoll,
    EffectValues,
    Number,
    ResultsPart,
    StageResults,
    item,
    results_of,
)
from irlos_pipe.stages.base import Declared, StageConfig, late
from irlos_pipe.stages.model.groups import (
    by_setup,
    of_several_setups,
    require_calibration,
    require_joint,
    require_parts,
)

VERSION = 34
NEEDS = ("ingest",)
ClosedNoll = Annotated[int, Field(ge=4, le=HIGHEST_NOLL)]
CUBES = "cubes"  # group of the arrays of every recording, with `each`
ARRAYS = {
    "noll": ("", "mode", "Noll index of every estimated mode"),
    "zernike_nm": ("nm ±", "mode", "static wavefront without the diversity"),
    "modes_nm": ("nm", "mode", "modes without the part of effects in the pupil"),
    "covariance_nm2": ("nm2", "mode, mode", "covariance of the modes; `errors_from` says what it is from"),
    "frames_nm": ("nm", "frame, mode", "coefficients of every frame; of several set-ups one after the other"),
    "frame_status": ("", "fit", "outcome of every fit"),
    "iterations": ("", "fit", "iterations of every fit"),
    "mean_image_e": ("e- ±", "y, x", "mean of the used frames"),
    "model_image_e": ("e-", "y, x", "model of the mean image"),
    "correlation": ("", "mode, mode", "correlation of the reported modes"),
    "left_frequency": ("D/λ", "frequency", "spatial frequency of the residual"),
    "left_power": ("", "frequency", "power of the residual over its standard error"),
    "left_nominal": ("", "frequency", "the same as a model that lacks nothing would leave it"),
    "effects/<effect>": ("", "parameter", "parameters of the effect, as it declares them"),
    "cubes/<name>/<array>": ("", "", "arrays of one recording, with calibrate.each"),
    "setup_images_e": ("e- ±", "set-up, y, x", "mean image of each of several set-ups fitted together"),
    "setup_models_e": ("e-", "set-up, y, x", "its model"),
}
CHECKS = {
    "converged fits": ("part of the fits that converged", "min_converged"),
    "chi2 of the mean image": (
        "reduced χ² of the mean image against what the scatter of the frames lets expect; a larger one says "
        "that the model lacks something",
        "max_chi2_nu",
    ),
    "error of the wavefront": (
        "quoted error of Noll 4–30, all together, behind an AO system whose speckles the frames show; it "
        "counts what the model misfits",
        "max_error_nm",
    ),
    "noise as told": ("scatter of the frames over the variance that the declared detector and star give", ""),
    "window": ("smaller side of the window in λ/D", "min_window"),
    "motion of the star": (
        "how far the star moves from frame to frame, over the smaller side of the window; before they are "
        "averaged, the frames are moved back",
        "max_motion",
    ),
    "frames": ("number of frames, where they scatter by more than noise", "min_frames"),
    "frames of one kind": (
        "kurtosis of the frames along what they differ by most: small where two stars or pointings are mixed",
        "",
    ),
    "orientation": (
        "how much of the mirrored pupil the mean image shows: 0 as declared, 1 if the images are mirrored",
        "",
    ),
    "twin solution": (
        "whether the sign of the even modes is known: 1 if the twin, which has it reversed, is excluded",
        "",
    ),
    "facts": (
        "where facts of the instrument follow the images (calibrate.adjust), those that differ from the "
        "declared ones by more than those of any instrument do",
        "",
    ),
    "planes": (
        "how much more or less two neighbouring planes are apart, by what each of them by itself wants, over "
        "the declared distance: from a half on one is nearer to where another should be",
        "",
    ),
}


class Limits(StageConfig):
    """Limits of the quality control, part of the stage's settings."""

    max_chi2_nu: float | None = item(
        None,
        "QC limit on the reduced chi-square of the mean image; null: by its nominal value, which "
        "the scatter of the frames tells",
        gt=0,
    )
    max_error_nm: float = item(
        12.0, "QC limit on the quoted error of Noll 4-30 behind an AO system [nm RMS]", gt=0
    )
    min_converged: float = item(0.9, "QC limit on the part of fits that converge", ge=0, le=1)
    min_frames: int = item(8, "QC limit on the frames where they scatter by more than noise", ge=1)
    max_motion: float = item(
        0.25, "QC limit on how far the star moves, over the smaller window side", gt=0, le=1
    )
    min_window: float = item(8.0, "QC limit on the smaller side of the window, in λ/D", ge=0)


class Config(Limits):
    """Settings of the calibration."""

    input: str = item("calibration", "recipe input that holds the cubes")
    each: bool = item(False, "calibrate every recording by itself instead of all together")
    method: MethodName = item(
        DEFAULT_METHOD, "calibration method: which images are fitted, and by how many wavefronts"
    )
    loss: LossName | None = item(
        CalibrationOptions.loss,
        "loss function (l1 is rounded within 1 sigma, huber within 2); null: that of the method",
    )
    optimiser: OptimiserName = item(
        CalibrationOptions.optimiser, "solver: Levenberg-Marquardt, or L-BFGS with autograd"
    )
    highest_noll: ClosedNoll | Literal["open"] | None = item(
        CalibrationOptions.highest_noll,
        "highest Noll mode estimated, from 2 on; open: all that the window shows, by a prior "
        "whose law is fitted; null: that of the method, open for long_exposure",
    )
    prior_scale: float | None = item(
        3.0, "width of the prior over that of the NCPA law; null: no prior", gt=0, le=1000
    )
    max_iterations: int = item(
        CalibrationOptions.max_iterations, "largest number of iterations of a fit", ge=1, le=10000
    )
    adjust: bool | Literal["auto"] = item(
        "auto",
        "let facts of the instrument (pupil, pixels, diversity) and mild effects follow the images, each "
        "within its tolerance, and add a ghost that explains most of a misfit, about a minute instead of "
        "seconds; auto: where the images contradict the declared instrument, and agree with one that differs "
        "from it by ordinary tolerances",
    )
    compare: tuple[MethodName, ...] = item((), "further methods to run, for comparison in the report only")

    @model_validator(mode="after")
    def _fits_together(self) -> "Config":
        can_be_open = METHODS[self.method].open
        if self.highest_noll == OPEN and not can_be_open:
            raise ValueError(
                f"'highest_noll: open' is not for method '{self.method}'; give a number, or null"
            )
        if self.adjust is True and (isinstance(self.highest_noll, int) or not can_be_open):
            raise ValueError(
                "'adjust' is for all modes that the window shows: leave out 'highest_noll', or take "
                f"method {DEFAULT_METHOD}"
            )
        if self.each and self.compare:
            raise ValueError("'compare' works on all recordings together; leave it out with 'each: true'")
        return self

    def options(self, ncpa_law: NcpaLaw, method: str | None = None) -> CalibrationOptions:
        """Options of the configured method with a prior from `ncpa_law`.

        Or those of another `method` as published: own loss, own modes, no prior.
        """
        if method is not None:
            return CalibrationOptions(method, max_iterations=self.max_iterations)
        return CalibrationOptions(
            self.method,
            self.loss,
            self.optimiser,
            self.highest_noll,
            None if self.prior_scale is None else NcpaPrior(ncpa_law, self.prior_scale),
            self.max_iterations,
            ncpa_law,
        )


class Tail(ResultsPart):
    """Modes beyond the closed basis: law, see `estimate.open_fit.TailLaw`, and RMS as estimated."""

    first_noll: int = item(0, "First of these modes.")
    amplitude_nm: Number = item(
        nan, "Standard deviation of a mode of the radial order n₁ of the first one [nm RMS]."
    )
    slope: Number = item(nan, "Exponent p of the law: the standard deviation falls as (n/n₁)^p.")
    wfe_nm: Number = item(nan, "RMS of all these modes as estimated.")


class Estimate(ResultsPart):
    """The part of the results that every estimate has."""

    method: str = item("", "How they were estimated, such as ``long_exposure`` or ``dip_global``.")
    zernike_nm: ByNoll = item(
        {}, "Reported modes of the static wavefront without the diversity, and their standard errors."
    )
    sigma_nm: ByNoll = item({}, DITTO)
    wfe_nm: Number = item(nan, "RMS of the reported modes, and the total error expected of them.")
    wfe_sigma_nm: Number = item(nan, DITTO)
    higher_nm: Number = item(
        nan,
        "RMS of the reported modes from Noll 4 on, which leaves out tip and tilt, the position of the star; "
        "and the total error expected of them.",
    )
    higher_sigma_nm: Number = item(nan, DITTO)
    tip_tilt_nm: Number = item(nan, "RMS of tip and tilt together, and their total error.")
    tip_tilt_sigma_nm: Number = item(nan, DITTO)
    frames: int = item(0, "Used frames.")
    errors_from: str = item(
        "frames",
        "``frames``: from their scatter; ``noise`` or ``few_frames``: see `estimate.calibration_errors`.",
    )
    seconds: Number = item(nan, "Time of the fit.")
    chi2_nu: Number = item(
        nan,
        "Reduced χ² of the mean image; what it would be about a model that lacks nothing, and by how much "
        "that varies by chance, see `estimate.calibration_errors`. Behind an AO system a complete model "
        "leaves less than 1: neighbouring pixels share the scatter of speckles, which the modes follow.",
    )
    nominal_chi2_nu: Number = item(nan, DITTO)
    nominal_chi2_nu_sigma: Number = item(nan, DITTO)
    loss: str = item("", "Function of the residuals that the fit minimises.")
    optimiser: str = item("", "Algorithm that minimises it.")
    modes_estimated: int | None = item(None, "Modes in the fit, more than are reported.")
    all_zernike_nm: ByNoll = item({}, "All estimated modes of the static wavefront, by Noll index [nm RMS].")
    tail: Tail | None = item(
        None, "What was found of the modes beyond the closed basis; None for a closed one."
    )
    status: dict[str, int] = item({}, "Number of fits by their outcome.")


class Lenslets(ResultsPart):
    """What the four images of a 2x2 mode determine, and what their centroids say."""

    modes_tried: int = item(
        0, "Modes from Noll 2 on, and how many combinations of them the images tell better than the prior."
    )
    combinations: int = item(0, DITTO)
    information: list[Number] = item(
        [], "Eigenvalues of the Fisher matrix in units of the prior, descending."
    )
    determined: list[int] = item([], "Modes whose error is at most half of the prior's.")
    left: ByNoll = item({}, "Error of every mode over that of its prior.")
    bound_nm: ByNoll = item(
        {}, "Cramér–Rao bound of the estimated modes: noise alone, no prior of the modes."
    )
    centroids_nm: ByNoll = item(
        {},
        "Modes from the centroids of the images, as of a Shack–Hartmann sensor, and their errors by the "
        "scatter of the frames.",
    )
    centroids_sigma_nm: ByNoll = item({}, DITTO)


class AngleRow(ResultsPart):
    """A recording and its derotator angle."""

    name: str = item("", "Name of the recording.")
    derotator_angle_deg: Number = item(nan, "Angle of the derotator when it was taken.")


class CubeRow(Estimate, AngleRow):
    """Estimate of one recording that was reduced by itself."""

    effects: dict[str, EffectValues] = item({}, "Estimated effects with the values of their parameters.")


class CalibrateResults(Estimate, StageResults):
    """One estimate from all recordings, or the mean over the `cubes` that were reduced one by one."""

    stage: ClassVar[str] = "calibrate"
    effects: dict[str, EffectValues] = item({}, "Estimated effects with the values of their parameters.")
    effects_sigma: dict[str, EffectValues] = item(
        {}, "Their standard errors, see `estimate.calibration_errors`; empty for the mean over `cubes`."
    )
    seeing_arcsec: Number = item(nan, "Seeing taken for the calibration.")
    wavelength_nm: Number = item(nan, "Mean wavelength of its recordings, at which the NCPAs are stated.")
    twin: TwinCheck | None = item(None, "None without a twin solution, and for the mean over cubes.")
    compare: list[Estimate] = item([], "Estimates with other methods.")
    setups: list[OneSetup] = item([], "Set-ups that were fitted together; empty for one.")
    adjusted: bool = item(False, "Whether facts of the instrument follow the images, see `calibrate.adjust`.")
    introduced_accuracy: Number = item(
        nan,
        "Part of itself, or of the RMS of all, by which an introduced defocus is off, one sigma.",
    )
    cubes: list[CubeRow] = []
    causes: list[Cause] = item(
        [], "What would explain the checks that failed, most likely first; empty where none did."
    )
    no_causes: str = item("", "Why there are none though a check failed.")
    lenslets: Lenslets | None = item(
        None, "What the images of a 2x2 mode determine; None for other recordings."
    )

    def effect_number(self, effect: str, parameter: str) -> float:
        """Return an estimated `parameter` of an `effect` as a number; NaN where there is none."""
        value = self.effects.get(effect, {}).get(parameter)
        return float(value) if isinstance(value, (int, float)) else math.nan


Results = CalibrateResults
run = late("irlos_pipe.stages.calibrate.work")


def require(declared: Declared[Config]) -> None:
    """See `Stage`."""
    config, recordings = declared.config, declared.recordings
    require_calibration(recordings)
    if not config.each and of_several_setups(recordings):
        require_joint(declared.model, by_setup(recordings), config.method, adjust=config.adjust is True)
    require_parts(declared)


@dataclass(frozen=True)
class CubeEstimate:
    """Estimate of one cube, as read from a product."""

    name: str
    derotator_angle_deg: float
    nolls: tuple[int, ...]
    zernike_nm: np.ndarray  # (modes,)
    sigma_nm: np.ndarray  # (modes,)
    covariance_nm2: np.ndarray  # (modes, modes)
    frames_nm: np.ndarray  # (frames, modes)


def cube_estimates(product: Product, stage: str) -> list[CubeEstimate]:
    """Return the estimates of a `calibrate` product made with ``each: true``, in the order of recording.

    Raises `ConfigurationError`, which names the `stage` that needs them, for another product.
    """
    found = []
    for row in results_of(CalibrateResults, product).cubes:
        nolls, zernike, covariance, frames = (
            product.arrays[f"{CUBES}/{row.name}/{name}"]
            for name in ("noll", "zernike_nm", "covariance_nm2", "frames_nm")
        )
        modes = tuple(nolls.value.tolist()), zernike.value, np.asarray(zernike.error)
        found.append(CubeEstimate(row.name, row.derotator_angle_deg, *modes, covariance.value, frames.value))
    if not found:
        raise ConfigurationError(f"{stage} needs the cubes one by one: set calibrate.each to true")
    return found
