"""What every frame of a recording shows of the star, without a model: for plots against time."""

import numpy as np

from irlos_pipe.frames.recording import blocks, frame_flux

HALF, CORE = 0.5, 0.1  # of the peak: from where the width counts, and the centroid
DECLARED = {
    "flux_e": ("e-", "frame", "sum of a frame over the window"),
    "peak_e": ("e-", "frame", "brightest good pixel of a frame above its level"),
    "level_e": ("e-", "frame", "median of the rim of the window, one pixel wide"),
    "fwhm_px": ("px", "frame", "diameter of the circle of the area above half the peak"),
    "x_px": ("px", "frame", "centroid of what stands above a tenth of the peak, from the window's centre"),
    "y_px": ("px", "frame", "centroid of what stands above a tenth of the peak, from the window's centre"),
}


def frame_series(images_e: np.ndarray, good: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers of `DECLARED` for images (frames, rows, columns); only `good` pixels count."""
    found = [_series(images_e[block], good) for block in blocks(len(images_e))]
    return {"flux_e": frame_flux(images_e)} | {
        name: np.concatenate([one[name] for one in found]) for name in found[0]
    }


def _series(images_e: np.ndarray, good: np.ndarray) -> dict[str, np.ndarray]:
    rim = np.ones(good.shape, bool)
    rim[1:-1, 1:-1] = False
    level = np.median(images_e[:, rim & good if (rim & good).any() else rim], axis=1)
    above = np.where(good, images_e - level[:, None, None], 0.0)
    peak = above.max(axis=(1, 2))
    half = HALF * peak[:, None, None]
    # The part of a pixel above half the peak: its value falls across it by the gradient.
    fall = sum(np.abs(np.gradient(above, axis=axis)) for axis in (1, 2) if above.shape[axis] > 1)
    area = np.clip(0.5 + (above - half) / np.maximum(fall, 1e-9), 0, 1).sum(axis=(1, 2))
    weight = np.where(above > CORE * peak[:, None, None], above, 0.0)
    total = np.maximum(weight.sum(axis=(1, 2)), 1e-9)
    y, x = (np.arange(size) - (size - 1) / 2 for size in good.shape)
    return {
        "peak_e": peak,
        "level_e": level,
        "fwhm_px": 2 * np.sqrt(area / np.pi),
        "x_px": weight.sum(axis=1) @ x / total,
        "y_px": weight.sum(axis=2) @ y / total,
    }
