"""Focus moved in a beam of high aperture: `high_aperture`."""

from __future__ import annotations

from dataclasses import replace

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.declaration import Conditions, Parameter, number
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.optics.defocus import HIGHEST_SINE
from irlos_pipe.optics.psf_settings import PsfSettings

LEAST_SINE = 0.1  # a focal ratio of 5, below which defocus is the parabola to 0.1 %


class HighAperture(LensEffect):
    """Defocus is a sphere and not a parabola, because the focus moves where the beam is steep.

    Noll 4 then comes with Noll 11, 22 and further ones in fixed proportion. A single image cannot tell them
    from static spherical aberration, a ramp of focus can: they change with it. An estimate with the parabola
    finds another slope than one and its images do not fit far from focus.

    Parameters
    ----------
    numerical_aperture : float
        NA / n of the beam in which the focus moves.
    """

    name = "high_aperture"
    formula = (
        "shape of defocus: √(1 − sine² ρ²) in place of ρ², ρ: radius over that of the pupil; same Noll 4"
    )
    public = (number("sine", "NA / n where the focus moves", 0.0, HIGHEST_SINE),)
    sentence = "a focus moved in a beam of NA / n = {sine:.2f}"
    look_alike = "focus_stage_scale in the estimates of a ramp; its images far from focus distinguish them"
    reference = "Hopkins 1945, Proc. Phys. Soc. 55, 116"

    def __init__(self, numerical_aperture: float = 0.0):
        self.parameters = (Parameter("sine", "", numerical_aperture, lower=0.0, upper=HIGHEST_SINE),)

    @classmethod
    def under(cls, conditions: Conditions) -> HighAperture:
        """See `Effect.under`: where the profile knows the aperture and it is high."""
        if not conditions.numerical_aperture > LEAST_SINE:
            raise ValueError("the profile knows no high numerical aperture of the beam in which focus moves")
        return cls(conditions.numerical_aperture)

    def apply(self, values: torch.Tensor, settings: PsfSettings) -> PsfSettings:
        """See `LensEffect.apply`."""
        return replace(settings, focus_sine=float(values[0]))
