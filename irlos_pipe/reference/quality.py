"""Checks of quality control."""

from __future__ import annotations

from collections.abc import Iterator

from irlos_pipe.reference.entry import Entry

# Name: what is checked, and the key of the recipe that holds its limit, if one does.
CHECKS = {
    "ingest.rejected": ("part of the frames that cannot be used", "ingest.max_rejected_fraction"),
    "ingest.saturated": ("part of the frames that are saturated", "ingest.max_saturated_fraction"),
    "ingest.missing": ("part of the frames that the recorder lost", "ingest.max_missing_fraction"),
    "ingest.bad_pixels": ("part of the window that is masked", "ingest.max_bad_pixel_fraction"),
    "ingest.centring": ("distance of the star from the window's centre", "ingest.max_centre_offset_fraction"),
    "prior.failed Gaussian fits": ("part of the frames whose elongation could not be measured", ""),
    "calibrate.converged fits": ("part of the fits that converged", "calibrate.min_converged"),
    "calibrate.chi2 of the mean image": (
        "reduced χ² of the mean image against what the scatter of the frames lets expect; a larger one says "
        "that the model lacks something",
        "calibrate.max_chi2_nu",
    ),
    "calibrate.noise as told": (
        "scatter of the frames over the variance that detector and star are told to have",
        "",
    ),
    "calibrate.window": ("smaller side of the window in λ/D", "calibrate.min_window"),
    "calibrate.motion of the star": (
        "how far the star moves from frame to frame, over the smaller side of the window; before they are "
        "averaged, the frames are moved back",
        "calibrate.max_motion",
    ),
    "calibrate.frames": ("number of frames, where they scatter by more than noise", "calibrate.min_frames"),
    "calibrate.frames of one kind": (
        "kurtosis of the frames along what they differ by most: small where two stars or pointings are mixed",
        "",
    ),
    "calibrate.orientation": (
        "how much of the mirrored pupil the mean image shows: 0 as told, 1 if the images are mirrored",
        "",
    ),
    "calibrate.twin solution": (
        "whether the sign of the even modes is known: 1 if the twin, which has it reversed, is excluded",
        "",
    ),
    "lift.converged frames": ("part of the frames whose fit converged", "lift.min_converged"),
    "lift.scatter about the line": ("RMS of the estimates about a straight line", "lift.max_residual_nm"),
    "lift.slope": ("slope of the estimated against the introduced defocus", "lift.max_slope_error"),
    "lift.chi2 of the frames": (
        "median reduced χ² of the frames against what their scatter lets expect",
        "lift.max_chi2_ratio",
    ),
    "lift.error": ("RMS of estimated minus introduced defocus", "lift.max_error_nm"),
    "lift.gain by the NCPAs": (
        "error with the NCPAs, which may not be worse than without them by more than their errors excuse",
        "",
    ),
    "correct.predicted Strehl": ("predicted Strehl against the best that the AO residual leaves", ""),
    "diagnose.frames of one kind": ("as that of `calibrate`", ""),
    "diagnose.motion of the star": ("as that of `calibrate`", ""),
    "diagnose.everything explained": ("whether the verdict leaves nothing significant unexplained", ""),
    "derotator.chi2 of the split": (
        "how well a part before and a part behind the derotator explain the estimates",
        "derotator.max_chi2_nu",
    ),
    "derotator.sense of rotation": ("how much worse the other sense of rotation fits", ""),
}


def check_entries() -> Iterator[Entry]:
    """Yield every check; a value out of its limits makes the exit code 4."""
    for name, (text, key) in CHECKS.items():
        yield Entry("check", name, f"{text}\nlimit: {key or 'fixed'}")
