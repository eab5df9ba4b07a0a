"""Curves of a diagnosis: OTF, encircled energy, and power of what is left, measured and predicted."""

from __future__ import annotations

import numpy as np

from irlos_pipe.diagnosis.verdict import Pictures
from irlos_pipe.frames.detector import star_position
from irlos_pipe.optics.image_quality import encircled_energy, power_spectrum, transfer_cut
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.product.product import Quantity, declared
from irlos_pipe.stages.diagnose.results import ARRAYS


def quality_arrays(pictures: Pictures, settings: PsfSettings) -> dict[str, Quantity]:
    """Return the curves of the mean held-out image and of its predictions.

    Pixels that are not used hold the prediction after in all three. Light is that of the window.

    Parameters
    ----------
    pictures : Pictures
    settings : PsfSettings
        Of the recording.
    """
    used = np.isfinite(pictures.sigma_e) & (pictures.sigma_e > 0)
    resolution_px, arrays = settings.resolution_px, dict[str, np.ndarray]()
    images = {"measured": pictures.measured_e, "before": pictures.before_e, "after": pictures.after_e}
    centre = star_position(np.nan_to_num(pictures.after_e))
    for name, image in images.items():
        whole = np.where(used, image, pictures.after_e)
        energy = encircled_energy(whole / whole.sum(), centre)
        arrays["encircled_radius_mas"] = energy.at * settings.pixel_scale_mas
        arrays[f"encircled_{name}"] = energy.value
        for axis, letter in ((1, "x"), (0, "y")):
            cut = transfer_cut(whole, resolution_px, axis)
            arrays |= {f"otf_{letter}_frequency": cut.at, f"otf_{letter}_{name}": cut.value}
    for name in ("before", "after"):
        left = np.where(
            used, (pictures.measured_e - images[name]) / np.where(used, pictures.sigma_e, 1), np.nan
        )
        power = power_spectrum(left, resolution_px)
        arrays |= {"left_frequency": power.at, f"left_power_{name}": power.value}
    return declared(ARRAYS, arrays)
