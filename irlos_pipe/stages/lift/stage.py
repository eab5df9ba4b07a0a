"""Stage `lift`: tip, tilt and defocus of every frame of a ramp, the NCPAs in the known wavefront."""

from collections.abc import Mapping
from math import hypot, nan
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.effects.wavefront import ChromaticNcpa, FilterNcpa
from irlos_pipe.estimate.calibration_options import LiftOptions, NoiseSource
from irlos_pipe.estimate.ramp import Line
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.product.results import DITTO, ByNoll, EffectValues, Number, ResultsPart, StageResults, item
from irlos_pipe.stages.base import Declared, StageConfig, late
from irlos_pipe.stages.model.groups import require_line, require_parts, require_ramp

VERSION = 19
NEEDS = ("ingest",)
READS = ("prior", "calibrate")
Mode = Annotated[int, Field(ge=2, le=HIGHEST_NOLL)]
# "told" is the former spelling of "commanded".
Start = Annotated[
    Literal["elongation", "scan", "commanded", "zero"],
    BeforeValidator(lambda value: "commanded" if value == "told" else value),
]
ObjectSigma = Literal["calibrated", "fit"] | Annotated[float, Field(ge=0, le=200)]
ARRAYS = {
    "noll": ("", "mode", "estimated modes"),
    "zernike_nm": ("nm ±", "frame, mode", "estimates, errors of photon noise"),
    "covariance_nm2": ("nm2", "frame, mode, mode", "covariance of the estimates"),
    "defocus_nm": ("nm ±", "frame", "estimated introduced defocus"),
    "introduced_nm": ("nm", "frame", "introduced defocus, frames in order of time"),
    "start_nm": ("nm", "frame, mode", "start of every frame"),
    "chi2_nu": ("", "frame", "χ²/ν of every frame"),
    "model_e": ("e-", "frame, y, x", "model of every frame"),
    "offsets_nm": ("nm", "offset", "the offsets of the ramp"),
    "measured_per_offset_e": ("e-", "offset, y, x", "mean frame of every offset"),
    "model_per_offset_e": ("e-", "offset, y, x", "mean model of every offset"),
    "curve_defocus_nm": ("nm", "value", "defocus at which one frame was held"),
    "curve_chi2_nu": ("", "value", "χ²/ν of the best fit of that frame with this defocus"),
}
CHECKS = {
    "converged frames": ("part of the frames whose fit converged", "min_converged"),
    "scatter about the line": ("RMS of the estimates about a straight line", "max_residual_nm"),
    "slope": ("slope of the estimated against the introduced defocus", "max_slope_error"),
    "chi2 of the frames": (
        "median reduced χ² of the frames against what their scatter lets expect",
        "max_chi2_ratio",
    ),
    "error": ("RMS of estimated minus introduced defocus", "max_error_nm"),
    "gain by the NCPAs": (
        "error with the NCPAs, which may not be worse than without them by more than their errors excuse",
        "",
    ),
}
OWN = (ChromaticNcpa, FilterNcpa)  # wavefronts that the light of a ramp has for itself


class Config(StageConfig):
    """Settings of LIFT."""

    input: str = item("ramp", "recipe input that holds the ramp")
    modes: tuple[Mode, ...] = item((2, 3, 4), "Noll modes to estimate; 4 (defocus) among them")
    common_modes: tuple[Annotated[int, Field(le=HIGHEST_NOLL)], ...] = item(
        (),
        "Noll modes of a static wavefront that all frames share, fitted to the ramp by phase "
        "diversity; instead of a calibration",
    )
    calibrated: bool = item(True, "make the NCPAs of `calibrate` a part of the known wavefront")
    halo: Literal["calibrated", "fit", "off"] = item(
        "calibrated", "AO residual in the model: as calibrated, fitted to the ramp, or none"
    )
    object_sigma_mas: ObjectSigma = item(
        "calibrated",
        "width of the kernel of object and jitter: a number [mas], as calibrated, or fitted to the ramp",
    )
    own_wavefront: Literal["auto", "always", "never"] = item(
        "auto",
        "fit what another filter or lens than the calibration's adds to the wavefront, by "
        "wavelength (chromatic_ncpa) and by itself (filter_ncpa): where the frames misfit, always or never",
    )
    estimator: Literal["ml", "map"] = item("ml", "maximum likelihood, or with a Gaussian prior")
    prior_scale: float = item(3.0, "width of the prior of MAP over that of the NCPA law", gt=0, le=1000)
    noise: NoiseSource = item(
        LiftOptions.noise,
        "variances of the pixels: from the data, from the start's model, or renewed with the fit",
    )
    loss: LossName = item(
        LiftOptions.loss,
        "loss function: the likelihood, huber (linear beyond 2 sigma: single wrong pixels count "
        "little), or the l1 of the paper's DIP; these two take the variances of the start's model",
    )
    start: Start = item(
        "elongation",
        "where the iteration begins: at the elongation prior, at the best of a scan of defocus, at the "
        "commanded defocus (needed without diversity, where the sign of defocus is ambiguous), or at zero",
    )
    max_iterations: int = item(
        LiftOptions.max_iterations, "largest number of iterations of a fit", ge=1, le=1000
    )
    singly: bool = item(
        False,
        "measure every frame by itself from a scan of defocus, to the bit as irlos focus does; "
        "modes 2, 3, 4 and nothing fitted to the ramp",
    )
    compare: bool = item(
        True,
        "repeat without the NCPAs and without the AO residual, and one frame at every defocus, "
        "for the report",
    )
    min_converged: float = item(0.9, "QC limit on the part of frames that converge", ge=0, le=1)
    max_residual_nm: float = item(30.0, "QC limit on the scatter about the straight line [nm RMS]", gt=0)
    max_slope_error: float = item(
        0.05, "QC limit on the slope's departure from 1; 5 of its standard errors if more", gt=0
    )
    max_error_nm: float = item(
        30.0, "QC limit on estimated minus introduced defocus, with NCPAs [nm RMS]", gt=0
    )
    max_chi2_ratio: float = item(
        1.75, "QC limit on the median chi-square of the frames over its nominal value", gt=1
    )
    unknown_nominal_chi2_nu: float = item(
        3.0, "nominal chi-square of a frame where no offset has two frames", gt=0
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "Config":
        named = (*self.modes, *self.common_modes)
        twice = sorted({noll for noll in named if named.count(noll) > 1})
        if twice:
            raise ValueError(f"mode {twice[0]} stands twice in 'modes' and 'common_modes'; name it once")
        if min(self.common_modes, default=2) < 2:
            raise ValueError("'common_modes' are Noll modes from 2 on")
        if self.estimator == "map" and not {*self.modes} - {2, 3, 4}:
            raise ValueError(
                "estimator 'map' leaves tip, tilt and defocus free, and 'modes' has no others; take 'ml'"
            )
        default = type(self).model_fields["prior_scale"].default
        if self.estimator == "ml" and self.prior_scale != default:
            raise ValueError("'prior_scale' is that of estimator 'map'; set that as well")
        fitted = self.halo == "fit" or self.object_sigma_mas == "fit" or bool(self.common_modes)
        other = sorted(self.modes) != [2, 3, 4] or self.estimator != "ml" or self.loss != "gaussian"
        if self.singly and (fitted or other):
            raise ValueError(
                "'singly' takes modes 2, 3 and 4, estimator 'ml', loss 'gaussian', and nothing that is "
                "fitted to the ramp"
            )
        return self


class Point(ResultsPart):
    """Estimate of one frame."""

    name: str = item("", "Recording, in which the frame has the number `frame`.")
    frame: int = item(0, "Number of the frame in its recording, from 0.")
    introduced_nm: Number = item(nan, "Introduced defocus as the model has it, and as commanded.")
    commanded_nm: Number = item(nan, DITTO)
    defocus_nm: Number = item(nan, "Estimate with its standard error; NaN where the fit is invalid.")
    sigma_nm: Number = item(nan, DITTO)
    sigma_photon_nm: Number = item(
        nan,
        "The parts of `sigma_nm`: by photon and read-out noise, which grows by the misfit of the model; of "
        "the instant, by which errors differ from frame to frame, above all by the AO residual's own "
        "defocus in the exposure; of the optics, by the covariance of the NCPAs, which all frames share.",
    )
    sigma_instant_nm: Number = item(nan, DITTO)
    sigma_optics_nm: Number = item(nan, DITTO)
    sigma_offset_nm: Number = item(
        0.0,
        "A fourth part, which all frames share as well: the offset of the ramp, where its error does not "
        "excuse it; else 0.",
    )
    converged: bool = item(True, "Whether the fit ended at a minimum.")
    status: str = item("", "How the fit of the frame ended.")
    chi2_nu: Number = item(nan, "Reduced χ² of the frame.")
    zernike_nm: ByNoll = item({}, "All estimated modes.")


class Offset(ResultsPart):
    """Median and 1σ scatter of the estimates at one introduced defocus."""

    introduced_nm: Number = item(nan, "Introduced defocus.")
    median_nm: Number = item(nan, "Median of the estimates there.")
    scatter_nm: Number = item(nan, "Their 1σ scatter, from the 16th and 84th percentile.")


class Twin(ResultsPart):
    """Whether the other sign of defocus is excluded, by a frame of median χ²/ν (`estimate.tabulated`)."""

    name: str = item("", "Recording, in which the frame has the number `frame`.")
    frame: int = item(0, "Number of the frame in its recording, from 0.")
    defocus_nm: Number = item(nan, "Best fit of the frame.")
    chi2_nu: Number = item(nan, DITTO)
    twin_nm: Number = item(nan, "Defocus and χ²/ν of the best of the other minima; NaN where there is none.")
    twin_chi2_nu: Number = item(nan, DITTO)
    delta_chi2: Number = item(
        nan,
        "χ² of that minus χ² of the best fit; the same divided by the χ²/ν of the best fit where that is "
        "more than 1. From 10 on the twin is excluded.",
    )
    evidence: Number = item(nan, DITTO)


class LiftResults(StageResults):
    """A ramp."""

    stage: ClassVar[str] = "lift"
    modes: list[int] = item([], "Estimated modes (Noll).")
    calibrated: bool = item(False, "Whether the NCPAs are part of the known wavefront.")
    points: list[Point] = []
    summary: Line = Line()
    offsets: list[Offset] = []
    effects: dict[str, EffectValues] = item(
        {}, "Effects that the fit used or found, and standard errors of those that were fitted to the ramp."
    )
    effects_sigma: dict[str, EffectValues] = item({}, DITTO)
    effects_fitted_jointly: bool = item(False, "Whether effects were fitted to all frames together.")
    compare: dict[str, Line] = item({}, "The same ramp with parts of the model left out.")
    twin: Twin = item(
        Twin(),
        "Whether the other sign of defocus is excluded, by one frame; without name where it was not looked "
        "for.",
    )
    ao_defocus_nm: Number = item(nan, "Scatter of the estimates at one offset beyond photon noise.")
    chi2_nu: Number = item(nan, "Median of the frames, and what their scatter lets expect of a right model.")
    nominal_chi2_nu: Number = item(nan, DITTO)


Results = LiftResults
run = late("irlos_pipe.stages.lift.work")


def require(declared: Declared[Config]) -> None:
    """See `Stage`."""
    require_ramp(declared.recordings)
    require_line(declared.recordings)
    require_parts(declared)


def own_text(effects: Mapping[str, Mapping[str, Any]]) -> str:
    """Return in words how large a wavefront of the ramp's own light is among `effects`; empty without one."""
    sizes = {kind.name: size_nm_of(effects[kind.name][kind.table]) for kind in OWN if kind.name in effects}
    units = {ChromaticNcpa.name: "nm RMS per µm of wavelength", FilterNcpa.name: "nm RMS of filter or lens"}
    texts = [f"{size:.0f} {units[name]}" for name, size in sizes.items()]
    return f"its own light adds {' and '.join(texts)}" if texts else ""


def size_nm_of(table: Any) -> float:
    return hypot(*table.values())
