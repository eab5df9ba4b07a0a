"""`anamorphism`: the scale of the image differs along two orthogonal axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.declaration import Parameter, direction, number
from irlos_pipe.effects.planes import SamplingEffect
from irlos_pipe.optics.grids import Sampling

LARGEST = 0.1  # fraction along either component; a detector tilted by 25° foreshortens one axis by as much
USUAL = 0.01  # a tilt of 8°; SPHERE's cylindrical mirrors make 0.6 %


class Anamorphism(SamplingEffect):
    """The image is stretched along one direction and compressed across it; areas stay.

    Tilted or cylindrical optics, gratings and a tilted detector do so. The size is the difference of the
    largest scale and the smallest over their mean, the angle that of the largest; the geometric mean of both
    is that of `plate_scale`.

    A pupil that is wider across the direction makes exactly the same diffraction pattern. It leaves the halo,
    the image motion and companions as they are, which an anamorphism stretches too: this alone tells the two
    apart, and where the halo may be elongated for itself, little of it.
    """

    name = "anamorphism"
    formula = (
        "I(a) → I(M⁻¹ a), M = (1 + E) / √(1 − ε²), E = ε (cos 2θ, sin 2θ; sin 2θ, −cos 2θ), ε = fraction / 2"
    )
    fact = True
    public = (
        number("fraction", "largest less smallest scale of the image, over their mean", 0.0, 0.14),
        direction("angle_deg", "deg of the largest, from +x towards +y, 0 to 180"),
    )
    sentence = "an image {percent:.2f} % larger along {angle_deg:.0f}° than across"
    look_alike = "a pupil wider across that direction; two stars of known places distinguish them"
    reference = "Maire et al. 2016, SPIE 9908, 990834: 0.60 % in SPHERE"
    parameters = tuple(
        Parameter(name, "", 0.0, prior_sigma=USUAL, lower=-LARGEST, upper=LARGEST, plausible=(-0.08, 0.08))
        for name in ("along_x", "along_diagonal")
    )

    def apply(self, values: torch.Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        """See `SamplingEffect.apply`."""
        return sampling._replace(strain=sampling.strain + values / 2)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Size and direction of the largest scale."""
        along_x, along_diagonal = (float(v) for v in values)
        angle_deg = float(np.rad2deg(np.arctan2(along_diagonal, along_x)) / 2 % 180)
        return {"fraction": float(np.hypot(along_x, along_diagonal)), "angle_deg": angle_deg}

    def values_of(self, fraction: float, angle_deg: float) -> list[float]:
        """See `Effect.values_of`."""
        twice = np.deg2rad(2 * angle_deg)
        return [fraction * float(np.cos(twice)), fraction * float(np.sin(twice))]

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: the size in per cent."""
        return super().phrase({**public, "percent": 100 * public["fraction"]})
