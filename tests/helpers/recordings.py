"""Recordings in memory."""

import numpy as np

from irlos_pipe.frames.recording import Acquisition, Detector, Recording

DETECTOR = Detector(1.0, 1.0)


def recording(
    images_e: np.ndarray, name="cube", owner="calibration", *, used=True, good=True, introduced_nm=0.0,
    start_unix_s=float("nan"), role="ncpa_calibration", detector=DETECTOR,
    spectrum=((1600.0, 1.0),), diversity=None, pixel_scale_mas=9.7, **observed,
) -> Recording:  # fmt: skip
    """Return frames (frames, rows, columns) taken ten times a second, in narrow H through the lens."""
    frames, window = len(images_e), images_e.shape[1:]
    kept = np.broadcast_to(np.asarray(used, bool), frames).copy()
    diversity = {6: -170.0} if diversity is None else diversity
    return Recording(
        name,
        owner,
        images_e.astype(np.float32),
        kept,
        np.where(kept, "", "saturated"),
        np.broadcast_to(np.asarray(good, bool), window).copy(),
        0.1 * np.arange(frames),
        np.arange(frames),
        np.broadcast_to(np.asarray(introduced_nm, float), frames).copy(),
        Acquisition(role, detector, spectrum, diversity, pixel_scale_mas, **observed),
        start_unix_s=start_unix_s,
    )
