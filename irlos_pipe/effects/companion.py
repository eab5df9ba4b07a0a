"""Copies of the star: `companion`, a second source, and `ghost`, an image that the optics make."""

from collections.abc import Sequence
from typing import Self

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.units import MAS
from irlos_pipe.effects.base import Effect, FixedEffect, Several, Values
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, direction
from irlos_pipe.effects.motion import damping
from irlos_pipe.effects.planes import CopyOfStar, OtfEffect
from irlos_pipe.effects.public_values import components, size_and_angle
from irlos_pipe.optics.fourier_matrices import phasor
from irlos_pipe.optics.grids import OtfGrid

STEP_MAS = 25.0  # of the grid of a search: less than the resolution at 1.2 µm
FAINT = 0.005  # flux of a second image that any camera makes
INNER_MAS = 30.0  # closer than this the pair is unresolved
LARGEST_BLUR_MAS = 200.0
DEFOCUS_SIGMA_NM, LARGEST_DEFOCUS_NM = 200.0, 1000.0


class CopiesOfStar(OtfEffect):
    """Adds a displaced image of the star; the first parameters are its flux ratio and its place [mas]."""

    copies_star = repeatable = True
    most: float  # plausible flux ratio

    def __init__(self, start: Sequence[float] = (0.01, 100.0, 0.0), reach_mas: float = 300.0):
        flux, x, y, *_ = start
        self.parameters = (
            Parameter("flux_ratio", "", flux, lower=0.0, upper=1.0, plausible=(0.0, self.most)),
            Parameter("x_mas", "mas", x, lower=-reach_mas, upper=reach_mas, null=None),
            Parameter("y_mas", "mas", y, lower=-reach_mas, upper=reach_mas, null=None),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> Self:
        return cls((0.01, conditions.reach_mas / 3, 0.0), conditions.reach_mas)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        flux, x, y, *_ = (float(v) for v in values)
        sep_mas, pa_deg = size_and_angle(x, y)
        return {"flux_ratio": flux, "sep_mas": sep_mas, "pa_deg": pa_deg}

    def ordinary(self, values: Values) -> bool:
        """See `Effect.ordinary`: a faint reflection."""
        return float(values[0]) <= FAINT

    def unusual(self, values: Values) -> list[str]:
        """See `Effect.unusual`: unresolved, it stands in for whatever makes the image longer."""
        close = np.hypot(float(values[1]), float(values[2])) < INNER_MAS
        return [*super().unusual(values), *(["sep_mas"] if close else [])]

    def displaced(self, x_mas: float, y_mas: float) -> FixedEffect:
        further = [0.0] * (len(self.parameters) - 3)
        return FixedEffect(self, [0.0, x_mas, y_mas, *further], free=("flux_ratio",))

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[FixedEffect]:
        reach = (n / 2 * pixel_scale_mas for n in window[::-1])
        columns, rows = (STEP_MAS * np.arange(-(r // STEP_MAS), r // STEP_MAS + 1) for r in reach)
        return [self.displaced(x, y) for y in rows for x in columns if np.hypot(x, y) >= INNER_MAS]


class Companion(CopiesOfStar):
    """Second source with the spectrum of the star, as sharp as the star: a binary, or a chance neighbour.

    The images of both add, ``(1 + f exp(-2πi b·s/λ)) / (1 + f)`` on the OTF. The total light stays; the
    position means nothing without the companion and is scanned in a search.

    Parameters: `start`, flux ratio and position [mas].
    """

    name = "companion"
    formula = "T(b) = (1 + f exp(−2πi b·s / λ)) / (1 + f), f = flux_ratio, s at sep_mas, pa_deg"
    belongs_to = "star"
    most = 0.9
    instrumental = False
    public = (
        Public("flux_ratio", "secondary over primary", 0.0, 1.0),
        Public("sep_mas", "mas", 0.0, 5000.0, role="position"),
        direction("pa_deg"),
    )
    sentence = "a second source of {flux_ratio:.2%} at {sep_mas:.0f} mas, PA {pa_deg:.0f}°"
    limit = "a companion of {flux_ratio:.1g}"
    look_alike = "vibration when closer than λ/D; a ghost, which other stars have too"
    reference = "Labeyrie 1970, A&A 6, 85"

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        flux, *_ = values
        return factor * (1 + copy_of_star(values, grid)) / (1 + flux)

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        return _Companions(effects)

    def values_of(self, flux_ratio: float, sep_mas: float, pa_deg: float) -> list[float]:
        return [flux_ratio, *components(sep_mas, pa_deg)]


class _Companions(Several, OtfEffect):
    """Several companions of one star."""

    name = Companion.name

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        every = self.all_of_each(values)
        light = 1 + sum((copy_of_star(one, grid) for one in every), torch.zeros(()))
        return factor * light / (1 + sum(one[0] for one in every))


def copy_of_star(values: Tensor, grid: OtfGrid) -> Tensor:
    """What a second image adds to the OTF of the star; `values`: flux ratio and place [mas], (3,)."""
    flux, x, y = values
    return flux * phasor(-2 * np.pi * grid.path_m(x * MAS, y * MAS) / grid.wavelengths_m)


class Ghost(CopiesOfStar):
    """Displaced image that a filter or window makes of whatever lies in the field.

    Light that two surfaces reflect comes to another focus, elsewhere, and through imperfect glass: the
    ghost has more defocus than the star and is blurred. Every star has it, at the same place and of the
    same share; a companion of the star has its ghost too. The total light stays.

    Parameters: `start`, flux ratio and position [mas]; further defocus [nm RMS] and blur [mas], none by
    default; `reach_mas`, largest distance along either axis.
    """

    name = "ghost"
    formula = (
        "I(a) → (I(a) + f I_g(a − s)) / (1 + f), f = flux_ratio; I_g: the star with defocus_nm more, "
        "blurred by blur_mas"
    )
    widens = Companion.name
    most = 0.5
    public = (
        Public("flux_ratio", "ghost over star", 0.0, 1.0),
        Public("sep_mas", "mas", 0.0, 5000.0, role="position"),
        direction("pa_deg"),
        Public("defocus_nm", "nm RMS, more than the star has", -1000.0, 1000.0, required=False),
        Public("blur_mas", "mas RMS per axis, beyond the star's", 0.0, LARGEST_BLUR_MAS, required=False),
    )
    sentence = (
        "a ghost of {flux_ratio:.2%} at {sep_mas:.0f} mas, PA {pa_deg:.0f}°, "
        "{defocus_nm:+.0f} nm out of focus and blurred by {blur_mas:.0f} mas"
    )
    look_alike = (
        "companion, which is as sharp as the star; another star, which has the ghost but no companion"
    )
    reference = "Goodman 2005, Introduction to Fourier Optics, section 6.4"

    def __init__(self, start: Sequence[float] = (0.01, 100.0, 0.0), reach_mas: float = 300.0):
        super().__init__(start, reach_mas)
        defocus, blur = start[3:] or (0.0, 0.0)
        limit = LARGEST_DEFOCUS_NM
        self.parameters += (
            Parameter("defocus_nm", "nm", defocus, 0.0, DEFOCUS_SIGMA_NM, -limit, limit, null=None),
            Parameter("blur_mas2", "mas²", blur**2, lower=0.0, upper=LARGEST_BLUR_MAS**2, null=None),
        )

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """See `OtfEffect.apply`: what is left for the star."""
        return factor / (1 + values[0])

    @property
    def further_paths(self) -> list[tuple[None, Effect]]:
        return [(None, _Image([self], 0))]

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        return _Ghosts(effects)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        defocus, blur2 = (float(v) for v in values[3:])
        return super().describe(values) | {"defocus_nm": defocus, "blur_mas": float(np.sqrt(max(blur2, 0.0)))}

    def values_of(
        self, flux_ratio: float, sep_mas: float, pa_deg: float, defocus_nm: float = 0.0, blur_mas: float = 0.0
    ) -> list[float]:
        return [flux_ratio, *components(sep_mas, pa_deg), defocus_nm, blur_mas**2]


class _Ghosts(Several, OtfEffect):
    """Several ghosts of one star."""

    name = Ghost.name

    @property
    def further_paths(self) -> list[tuple[None, Effect]]:
        return [(None, _Image(self.every, number)) for number in range(len(self.every))]

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """See `OtfEffect.apply`: what is left for the star."""
        return factor / _light(self.all_of_each(values))


class _Image(_Ghosts, CopyOfStar):
    """The image of one of several ghosts, of that `number`."""

    def __init__(self, ghosts: Sequence[Effect], number: int):
        super().__init__(ghosts)
        self.number = number

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        every = self.all_of_each(values)
        own = every[self.number]
        blurred = torch.exp(-damping(own[4], grid.length2_m2, grid))
        return factor * copy_of_star(own[:3], grid) * blurred / _light(every)

    def defocus_nm(self, values: Tensor) -> Tensor:
        return self.all_of_each(values)[self.number][3]


def _light(every: Sequence[Tensor]) -> Tensor:
    """Light of the star and its ghosts, each with all its parameters, in units of the star's."""
    return 1 + torch.stack([one[0] for one in every]).sum()
