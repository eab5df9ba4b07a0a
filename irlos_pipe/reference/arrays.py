"""Arrays of the products: what each of them is, by stage and name."""

from __future__ import annotations

import re
from collections.abc import Iterator

from irlos_pipe.reference.entry import Entry

# Name: unit, shape, what it is; ± says that the product holds errors beside it. Of a name in angle brackets
# there are several: recordings, effects, curves.
ARRAYS: dict[str, tuple[str, str, str]] = {
    "ingest.recordings/<input>/<name>/images_e": ("e-", "frame, y, x", "signal above background"),
    "ingest.recordings/<input>/<name>/mean_e": ("e-", "y, x", "mean of the used frames"),
    "ingest.recordings/<input>/<name>/raw_adu": ("ADU", "frame, y, x", "counts as recorded"),
    "ingest.recordings/<input>/<name>/used": ("", "frame", "whether a frame is used"),
    "ingest.recordings/<input>/<name>/reason": ("", "frame", "why a frame is not used"),
    "ingest.recordings/<input>/<name>/pixel_mask": ("", "y, x", "whether a pixel is good"),
    "ingest.recordings/<input>/<name>/time_s": ("s", "frame", "time since the first frame"),
    "ingest.recordings/<input>/<name>/start_unix_s": ("s", "", "time of the first frame since 1970"),
    "ingest.recordings/<input>/<name>/frame_counter": ("", "frame", "counter of the recorder"),
    "ingest.recordings/<input>/<name>/frames_missing": ("", "", "frames that the recorder lost"),
    "ingest.recordings/<input>/<name>/introduced_defocus_nm": ("nm", "frame", "introduced defocus, RMS"),
    "ingest.recordings/<input>/<name>/background_adu": ("ADU", "y, x", "subtracted from the counts"),
    "ingest.recordings/<input>/<name>/background_variance_e2": (
        "e-2", "", "variance per pixel beyond read noise and photons of the star",
    ),
    "ingest.recordings/<input>/<name>/dark_variance_e2": (
        "e-2", "", "variance per pixel of the dark image, the same in every frame",
    ),
    "ingest.recordings/<input>/<name>/flat": ("", "y, x", "relative response, divided out"),
    "ingest.recordings/<input>/<name>/cosmic_hits": ("", "hit, 3", "replaced pixels: frame, row, column"),
    "ingest.recordings/<input>/<name>/screened_e": (
        "e-", "pixel", "mean signal of the pixels in bad_pixels_found, as they were recorded",
    ),
    "ingest.recordings/<input>/<name>/acquisition": (
        "", "", "how it was taken, and where each key came from (JSON)",
    ),
    "prior.defocus_nm": ("nm", "frame", "prior of the defocus, frames in order of time"),
    "prior.introduced_nm": ("nm", "frame", "introduced defocus"),
    "prior.ratio": ("", "frame", "axis ratio of the fitted Gaussian, first over second axis"),
    "calibrate.noll": ("", "mode", "Noll index of every estimated mode"),
    "calibrate.zernike_nm": ("nm ±", "mode", "static wavefront without the diversity"),
    "calibrate.modes_nm": ("nm", "mode", "modes without the part of effects in the pupil"),
    "calibrate.covariance_nm2": ("nm2", "mode, mode", "of the modes; results say what it is from"),
    "calibrate.frames_nm": ("nm", "frame, mode", "coefficients of every frame"),
    "calibrate.frame_status": ("", "fit", "outcome of every fit"),
    "calibrate.iterations": ("", "fit", "of every fit"),
    "calibrate.mean_image_e": ("e- ±", "y, x", "mean of the used frames"),
    "calibrate.model_image_e": ("e-", "y, x", "its model"),
    "calibrate.correlation": ("", "mode, mode", "of the reported modes"),
    "calibrate.left_frequency": ("D/λ", "frequency", "spatial frequency of the residual"),
    "calibrate.left_power": ("", "frequency", "power of the residual over its standard error"),
    "calibrate.effects/<effect>": ("", "parameter", "parameters of the effect, as it declares them"),
    "calibrate.cubes/<name>/<array>": ("", "", "arrays of one recording, with calibrate.each"),
    "lift.noll": ("", "mode", "estimated modes"),
    "lift.zernike_nm": ("nm ±", "frame, mode", "estimates, errors of photon noise"),
    "lift.covariance_nm2": ("nm2", "frame, mode, mode", "per frame"),
    "lift.defocus_nm": ("nm ±", "frame", "estimated introduced defocus"),
    "lift.introduced_nm": ("nm", "frame", "introduced defocus, frames in order of time"),
    "lift.start_nm": ("nm", "frame, mode", "start of every frame"),
    "lift.chi2_nu": ("", "frame", "per frame"),
    "lift.model_e": ("e-", "frame, y, x", "model of every frame"),
    "lift.offsets_nm": ("nm", "offset", "the offsets of the ramp"),
    "lift.measured_per_offset_e": ("e-", "offset, y, x", "mean frame of every offset"),
    "lift.model_per_offset_e": ("e-", "offset, y, x", "mean model of every offset"),
    "lift.curve_defocus_nm": ("nm", "value", "defocus at which one frame was held"),
    "lift.curve_chi2_nu": ("", "value", "of the best fit of that frame with this defocus"),
    "lift.effects/<effect>": ("", "parameter", "parameters of an effect fitted to the ramp"),
    "sensitivity.curves/<n>/mag_j": ("mag", "magnitude", "J magnitude of the dimmed star"),
    "sensitivity.curves/<n>/median_abs_error_nm": ("nm", "magnitude", "median of |estimated − introduced|"),
    "sensitivity.curves/<n>/p16_nm": ("nm", "magnitude", "its 16th percentile"),
    "sensitivity.curves/<n>/p84_nm": ("nm", "magnitude", "its 84th percentile"),
    "sensitivity.curves/<n>/crb_nm": ("nm", "magnitude", "Cramér–Rao bound, 1σ"),
    "sensitivity.curves/<n>/one_read_crb_nm": ("nm", "magnitude", "the same for one read without sky"),
    "sensitivity.curves/<n>/failures": ("", "magnitude", "estimates that failed"),
    "correct.noll": ("", "mode", "Noll index"),
    "correct.offset_nm": ("nm ±", "mode", "offset = −NCPA, to be added to the reference; RMS"),
    "correct.mirror_offset": ("±", "mode", "offset of each mode of a mirror, in the unit of their table"),
    "correct.wavefront_before_nm": ("nm", "y, x", "estimated wavefront without tip and tilt"),
    "correct.wavefront_after_nm": ("nm", "y, x", "what the offsets leave of it"),
    "correct.before": ("", "y, x", "unit-flux image without correction"),
    "correct.after": ("", "y, x", "unit-flux image with the offsets applied"),
    "correct.perfect": ("", "y, x", "unit-flux image without aberration"),
    "correct.radius_mas": ("mas", "ring", "radius of the rings"),
    "correct.profile_before": ("", "ring", "mean of each ring, without correction"),
    "correct.profile_after": ("", "ring", "mean of each ring, with the offsets applied"),
    "correct.encircled_radius_mas": ("mas", "radius", "radius of circles about the star"),
    "correct.encircled_<image>": ("", "radius", "part of the light within a circle"),
    "correct.otf_x_frequency": ("D/λ", "frequency", "spatial frequency along x"),
    "correct.otf_y_frequency": ("D/λ", "frequency", "spatial frequency along y"),
    "correct.otf_x_<image>": ("", "frequency", "modulus of the OTF along x"),
    "correct.otf_y_<image>": ("", "frequency", "modulus of the OTF along y"),
    "derotator.noll": ("", "mode", "Noll index"),
    "derotator.angle_deg": ("deg", "cube", "turn of the wavefront before the derotator"),
    "derotator.zernike_nm": ("nm ±", "cube, mode", "as measured"),
    "derotator.turned_back_nm": ("nm ±", "cube, mode", "before the derotator"),
    "derotator.rotating_nm": ("nm ±", "mode", "turns with the derotator, as at angle 0"),
    "derotator.fixed_nm": ("nm ±", "mode", "does not turn"),
    "derotator.unsplit_nm": ("nm ±", "mode", "sum of both in modes that cannot be split"),
    "derotator.maps/<array>": ("nm", "…, y, x", "the same as maps, without tip and tilt"),
    "modes.noll": ("", "mode", "Noll index"),
    "modes.std_nm": ("nm ±", "mode", "RMS over the draws, about zero"),
    "modes.noise_nm": ("nm", "mode", "part of it due to the errors of the estimates"),
    "modes.frame_std_nm": ("nm", "mode", "over the frames of a cube: AO residual and noise, no NCPAs"),
    "modes.law/<law>": ("nm", "mode", "law of the estimates, and of the NCPAs without their errors"),
    "modes.numbers/highest_noll": ("", "number", "modes Noll 2 to this"),
    "modes.numbers/noll": ("", "mode", "modes that are compared"),
    "modes.numbers/zernike_nm": ("nm", "cube, number, half, mode", "estimates"),
    "modes.numbers/misfit": ("", "cube, number, block", "χ²/ν of unseen frames"),
    "modes.numbers/excess": ("±", "number", "held-out χ²/ν above the least"),
    "diagnose.measured_e": ("e- ±", "y, x", "mean of the held-out frames"),
    "diagnose.before_e": ("e-", "y, x", "predicted by the model as it was"),
    "diagnose.after_e": ("e-", "y, x", "predicted by the model with what was found"),
    "diagnose.leading_mode": ("sigma", "y, x", "leading mode of the residual over the frames"),
    "diagnose.added_opd_nm": ("nm", "y, x of the pupil", "wavefront that was added"),
    "diagnose.added_amplitude": ("", "y, x of the pupil", "amplitude that was added"),
    "diagnose.noll": ("", "mode", "Noll index of every mode in the model"),
    "diagnose.zernike_before_nm": ("nm", "mode", "total static wavefront, model as it was"),
    "diagnose.zernike_after_nm": ("nm ±", "mode", "total static wavefront, with what was found"),
    "diagnose.encircled_radius_mas": ("mas", "radius", "radius of circles about the star"),
    "diagnose.encircled_<image>": ("", "radius", "part of the light within a circle"),
    "diagnose.otf_x_frequency": ("D/λ", "frequency", "spatial frequency along x"),
    "diagnose.otf_y_frequency": ("D/λ", "frequency", "spatial frequency along y"),
    "diagnose.otf_x_<image>": ("", "frequency", "modulus of the OTF along x"),
    "diagnose.otf_y_<image>": ("", "frequency", "modulus of the OTF along y"),
    "diagnose.left_frequency": ("D/λ", "frequency", "spatial frequency of the residual"),
    "diagnose.left_power_<model>": ("", "frequency", "power of the residual over its standard error"),
    "diagnose.commanded_nm": ("nm", "frame", "of a ramp: commanded defocus"),
    "diagnose.corrected_nm": ("nm", "frame", "of a ramp: introduced defocus with what was found"),
    "diagnose.estimated_nm": ("nm", "frame", "of a ramp: estimate of every frame"),
}  # fmt: skip
ANY_OF = re.compile(r"<[^>]*>")


def array_entries() -> Iterator[Entry]:
    """Yield every array of every product."""
    for name, (unit, shape, text) in ARRAYS.items():
        lines = [text, *([f"unit: {unit}"] if unit else []), *([f"shape: ({shape})"] if shape else [])]
        yield Entry("array of a product", name, "\n".join(lines))


def listed(stage: str, name: str) -> str | None:
    """Return the name under which the array `name` of the product of `stage` is listed, or None."""
    whole = f"{stage}.{name}"
    patterns = (".+".join(map(re.escape, ANY_OF.split(known))) for known in ARRAYS)
    matches = zip(ARRAYS, patterns, strict=True)
    return next((known for known, pattern in matches if re.fullmatch(pattern, whole)), None)
