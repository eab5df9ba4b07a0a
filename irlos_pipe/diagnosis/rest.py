"""What a model still misses, in words and numbers: how much light, where, how large, and when."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy import ndimage

from irlos_pipe.diagnosis.held_out import HeldOutEvaluation
from irlos_pipe.diagnosis.records import FineStructure
from irlos_pipe.optics.psf_settings import PsfSettings

SMOOTH_PX = 1.0  # of the residual, before its strongest part is looked for
HALF = 0.5  # part of the maximum down to which its strongest part reaches
ALIKE = 0.5  # correlation from which two halves show the same
CORE = 0.5  # part of the brightest pixel from which pixels belong to the star

Symmetry = Literal["symmetric", "antisymmetric", "one-sided"]
Time = Literal["static", "moving", "not seen"]


@dataclass(frozen=True)
class Rest:
    """The residual between the held-out images and the final model."""

    light_fraction: float  # part of the light that is misplaced beyond what noise alone shows
    x_mas: float  # of its strongest part, from the star, to the right
    y_mas: float  # the same, up
    extent_mas: float  # diameter of a disc as large as the strongest part
    excess: bool  # whether there is too much light in its strongest part, not too little
    symmetry: Symmetry  # under a half turn about the star
    time: Time  # whether the two halves of the frames leave the same
    finer_than_diffraction: bool
    # Relative error of the flat that would make what is finer; 0 where none is significant.
    flat_rms: float = 0.0

    @property
    def text(self) -> str:
        sign = "brighter" if self.excess else "fainter"
        fine = ", partly finer than the diffraction limit" if self.finer_than_diffraction else ""
        if fine and self.flat_rms:
            fine += f" as an error of the flat of {self.flat_rms:.2%} RMS would make it"
        when = "" if self.time == "not seen" else f", {self.time}"
        return (
            f"{self.light_fraction:.1%} of the light is misplaced beyond noise, most of it "
            f"{self.x_mas:+.0f}, {self.y_mas:+.0f} mas from the star over {self.extent_mas:.0f} mas, where "
            f"the data are {sign}; {self.symmetry}{when}{fine}"
        )


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
    return Rest(
        light_fraction=float(np.sqrt(max(judge.gap**2 - floor**2, 0.0))),
        x_mas=(column - star_x) * scale,
        y_mas=(row - star_y) * scale,
        extent_mas=2 * float(np.sqrt(area_px / np.pi)) * scale,
        excess=sign > 0,
        symmetry=_symmetry(left, star_y, star_x),
        time=_time(judge),
        finer_than_diffraction=fine.significance > sure,
        flat_rms=flat_rms,
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
