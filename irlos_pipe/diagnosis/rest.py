"""What a model still misses, in words and numbers: how much light, where, how large, and when."""

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from scipy import ndimage

from irlos_pipe.diagnosis.held_out import HeldOutEvaluation
from irlos_pipe.diagnosis.records import FineStructure, Rest, Where
from irlos_pipe.optics.psf_settings import PsfSettings

SMOOTH_PX = 1.0  # of the residual, before its strongest part is looked for
HALF = 0.5  # part of the maximum down to which its strongest part reaches
ALIKE = 0.5  # correlation from which two halves show the same
CORE = 0.5  # part of the brightest pixel from which pixels belong to the star

Symmetry = Literal["symmetric", "antisymmetric", "one-sided"]
Time = Literal["static", "moving", "not seen"]


def rest_of(
    judge: HeldOutEvaluation,
    floor: float,
    fine: FineStructure,
    sure: float,
    settings: PsfSettings,
    flat_rms: float = 0.0,
) -> Rest:
    """Describe what the final model leaves of the held-out frames of the first recording.

    Noise alone leaves a gap of `floor`; fine structure counts from `sure` σ; for `flat_rms` see there.
    """
    pixels, window = judge.pixels[0], settings.window
    image = judge.mean_e[pixels].reshape(window).numpy()
    left = _left(judge, judge.stack.mean_e)[pixels].reshape(window).numpy()
    star_y, star_x = _star(image)
    row, column, area_px, sign = _strongest(left)
    scale = settings.pixel_scale_mas
    rest = Rest(
        light_fraction=float(np.sqrt(max(judge.gap**2 - floor**2, 0.0))),
        where=Where(
            (column - star_x) * scale, (row - star_y) * scale, 2 * float(np.sqrt(area_px / np.pi)) * scale
        ),
        excess=sign > 0,
        symmetry=_symmetry(left, star_y, star_x),
        time=_time(judge),
        finer_than_diffraction=fine.significance > sure,
        flat_rms=flat_rms,
    )
    return replace(rest, text=_text(rest))


def _text(rest: Rest) -> str:
    sign, at = "brighter" if rest.excess else "fainter", rest.where
    fine = ", partly finer than the diffraction limit" if rest.finer_than_diffraction else ""
    if fine and rest.flat_rms:
        fine += f" as an error of the flat of {rest.flat_rms:.2%} RMS would make it"
    when = "" if rest.time == "not seen" else f", {rest.time}"
    return (
        f"{rest.light_fraction:.1%} of the light is misplaced beyond noise, most of it "
        f"{at.x_mas:+.0f}, {at.y_mas:+.0f} mas from the star over {at.extent_mas:.0f} mas, where "
        f"the data are {sign}; {rest.symmetry}{when}{fine}"
    )


def _left(judge: HeldOutEvaluation, mean_e: torch.Tensor) -> torch.Tensor:
    """What a mean image shows beyond the prediction, pointing and flux refitted, 0 in bad pixels [e-]."""
    root = judge.stack.root
    white = torch.where(root > 0, mean_e - judge.image, 0.0) * root
    white = white - judge.basis @ (judge.basis.mT @ white)
    return torch.where(root > 0, white / root.clamp_min(1e-300), 0.0)


def _star(image: np.ndarray) -> tuple[float, float]:
    """Row and column of the centroid of the brightest pixels."""
    y, x = ndimage.center_of_mass(np.where(image > CORE * image.max(), image, 0.0))
    return float(y), float(x)


def _strongest(left: np.ndarray) -> tuple[float, float, int, float]:
    """Row, column, pixels and sign of the connected part of `left` that holds its largest value."""
    calm = ndimage.gaussian_filter(left, SMOOTH_PX)
    peak = np.unravel_index(np.argmax(np.abs(calm)), calm.shape)
    sign = float(np.sign(calm[peak]))
    parts, _ = ndimage.label(sign * calm > HALF * abs(calm[peak]))
    own = parts == parts[peak]
    y, x = ndimage.center_of_mass(np.abs(calm), own)
    return float(y), float(x), int(own.sum()), sign


def _symmetry(left: np.ndarray, star_y: float, star_x: float) -> Symmetry:
    """How `left` changes under a half turn about the star."""
    rows, columns = (np.arange(size) for size in left.shape)
    y, x = np.meshgrid(2 * star_y - rows, 2 * star_x - columns, indexing="ij")
    turned = ndimage.map_coordinates(left, [y, x], order=1, cval=0.0)
    likeness = float((left * turned).sum() / max((left**2).sum(), 1e-300))
    if abs(likeness) < ALIKE:
        return "one-sided"
    return "symmetric" if likeness > 0 else "antisymmetric"


def _time(judge: HeldOutEvaluation) -> Time:
    """Whether the two halves of the held-out frames of the first recording leave the same."""
    stack = judge.stack.parts[0]
    if not judge.stack.in_time or len(stack) < 4:
        return "not seen"
    images = stack.frames.images_e.double().flatten(1)
    images = images * (images.sum(1).mean() / images.sum(1, keepdim=True))
    halves = []
    for half in (images[: len(images) // 2], images[len(images) // 2 :]):
        mean = judge.stack.mean_e.clone()
        mean[judge.pixels[0]] = half.mean(0)
        halves.append(_left(judge, mean)[judge.pixels[0]])
    likeness = float(halves[0] @ halves[1] / (halves[0].norm() * halves[1].norm()).clamp_min(1e-300))
    return "static" if likeness > ALIKE else "moving"
