"""`ghost`: an image of the star that the optics displace, out of focus and blurred."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.companion import Companion, CopiesOfStar, SeveralCopies, copy_of_star
from irlos_pipe.effects.declaration import Conditions, Parameter, direction, number
from irlos_pipe.effects.motion import damping
from irlos_pipe.effects.planes import CopyOfStar
from irlos_pipe.effects.public_values import components, size_and_angle
from irlos_pipe.optics.grids import OtfGrid

LARGEST_BLUR_MAS = 200.0
DEFOCUS_SIGMA_NM, LARGEST_DEFOCUS_NM = 200.0, 1000.0


class Ghost(CopiesOfStar):
    """Displaced image that a filter or window makes of whatever lies in the field.

    Light that two surfaces reflect comes to another focus, elsewhere, and through imperfect glass: the
    ghost has more defocus than the star and is blurred. Every star has it, at the same place and of the
    same share; a companion of the star has its ghost too. The total light stays.

    Parameters
    ----------
    start : (float, float, float, float, float)
        Flux ratio, position [mas], further defocus [nm RMS] and blur [mas].
    reach_mas : float
        Largest distance along either axis.
    """

    name = "ghost"
    formula = (
        "I(a) → (I(a) + f I_g(a − s)) / (1 + f), f = flux_ratio; I_g: the star with defocus_nm more, "
        "blurred by blur_mas"
    )
    widens = Companion.name
    public = (
        number("flux_ratio", "ghost over star", 0.0, 1.0),
        number("sep_mas", "mas", 0.0, 5000.0, role="position"),
        direction("pa_deg"),
        number("defocus_nm", "nm RMS, more than the star has", -1000.0, 1000.0, required=False),
        number("blur_mas", "mas RMS per axis, beyond the star's", 0.0, LARGEST_BLUR_MAS, required=False),
    )
    sentence = (
        "a ghost of {flux_ratio:.2%} at {sep_mas:.0f} mas, PA {pa_deg:.0f}°, "
        "{defocus_nm:+.0f} nm out of focus and blurred by {blur_mas:.0f} mas"
    )
    look_alike = (
        "companion, which is as sharp as the star; another star, which has the ghost but no companion"
    )
    reference = "Goodman 2005, Introduction to Fourier Optics, section 6.4"

    def __init__(
        self,
        start: tuple[float, float, float, float, float] = (0.01, 100.0, 0.0, 0.0, 0.0),
        reach_mas: float = 300.0,
    ):
        flux, x, y, defocus, blur = start
        limit = LARGEST_DEFOCUS_NM
        self.parameters = (
            Parameter("flux_ratio", "", flux, lower=0.0, upper=1.0, plausible=(0.0, 0.5)),
            Parameter("x_mas", "mas", x, lower=-reach_mas, upper=reach_mas, null=None),
            Parameter("y_mas", "mas", y, lower=-reach_mas, upper=reach_mas, null=None),
            Parameter("defocus_nm", "nm", defocus, 0.0, DEFOCUS_SIGMA_NM, -limit, limit, null=None),
            Parameter("blur_mas2", "mas²", blur**2, lower=0.0, upper=LARGEST_BLUR_MAS**2, null=None),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> Ghost:
        """Within half the window's width of the star on every side."""
        return cls((0.01, conditions.reach_mas / 3, 0.0, 0.0, 0.0), conditions.reach_mas)

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`: what is left for the star."""
        return factor / (1 + values[0])

    @property
    def further_paths(self) -> list[tuple[None, Effect]]:
        """See `Effect.further_paths`."""
        return [(None, _Image([self], 0))]

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        """See `Effect.together`: every ghost is one of the star."""
        return _Ghosts(effects)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Flux ratio, separation, position angle, defocus and blur."""
        flux, x, y, defocus, blur2 = (float(v) for v in values)
        sep_mas, pa_deg = size_and_angle(x, y)
        blur_mas = float(np.sqrt(max(blur2, 0.0)))
        return {
            "flux_ratio": flux,
            "sep_mas": sep_mas,
            "pa_deg": pa_deg,
            "defocus_nm": defocus,
            "blur_mas": blur_mas,
        }

    def values_of(
        self, flux_ratio: float, sep_mas: float, pa_deg: float, defocus_nm: float = 0.0, blur_mas: float = 0.0
    ) -> list[float]:
        """See `Effect.values_of`: by default as sharp as the star."""
        return [flux_ratio, *components(sep_mas, pa_deg), defocus_nm, blur_mas**2]


class _Ghosts(SeveralCopies):
    """Several ghosts of one star."""

    name = Ghost.name

    @property
    def further_paths(self) -> list[tuple[None, Effect]]:
        """See `Effect.further_paths`."""
        return [(None, _Image(self.every, number)) for number in range(len(self.every))]

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`: what is left for the star."""
        return factor / _light(self.all_of_each(values))


class _Image(_Ghosts, CopyOfStar):
    """The image of one of several ghosts.

    Parameters
    ----------
    ghosts : sequence of Effect
    number : int
        Of the one.
    """

    def __init__(self, ghosts: Sequence[Effect], number: int):
        super().__init__(ghosts)
        self.number = number

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        every = self.all_of_each(values)
        own = every[self.number]
        blurred = torch.exp(-damping(own[4], grid.length2_m2, grid))
        return factor * copy_of_star(own[:3], grid) * blurred / _light(every)

    def defocus_nm(self, values: torch.Tensor) -> torch.Tensor:
        """See `CopyOfStar.defocus_nm`."""
        return self.all_of_each(values)[self.number][3]


def _light(every: Sequence[torch.Tensor]) -> torch.Tensor:
    """Light of the star and its ghosts, each with all its parameters, in units of the star's."""
    return 1 + torch.stack([one[0] for one in every]).sum()
