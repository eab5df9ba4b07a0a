"""`companion`: a second, fainter source in the window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.units import MAS
from irlos_pipe.effects.base import Effect, FixedEffect, Values
from irlos_pipe.effects.declaration import Conditions, Parameter, direction, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.effects.public_values import components, size_and_angle
from irlos_pipe.optics.fourier_matrices import phasor
from irlos_pipe.optics.grids import OtfGrid

STEP_MAS = 25.0  # of a search: less than the resolution at 1.2 µm
FAINT = 0.005  # flux of a second image that any camera makes
INNER_MAS = 30.0  # closer than this the pair is unresolved


class CopiesOfStar(OtfEffect):
    """Adds a displaced image of the star; the first parameters are its flux ratio and its place [mas]."""

    copies_star = repeatable = True

    def ordinary(self, values: Values) -> bool:
        """See `Effect.ordinary`: a faint reflection."""
        return float(values[0]) <= FAINT

    def unusual(self, values: Values) -> list[str]:
        """See `Effect.unusual`: unresolved, it stands in for whatever makes the image longer."""
        close = np.hypot(float(values[1]), float(values[2])) < INNER_MAS
        return [*super().unusual(values), *(["sep_mas"] if close else [])]

    def displaced(self, x_mas: float, y_mas: float) -> FixedEffect:
        """See `Effect.displaced`: as sharp as the star."""
        further = [0.0] * (len(self.parameters) - 3)
        return FixedEffect(self, [0.0, x_mas, y_mas, *further], free=("flux_ratio",))

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[FixedEffect]:
        """See `Effect.candidates`: one per position on a grid over half the window about the star."""
        reach = (n / 2 * pixel_scale_mas for n in window[::-1])
        columns, rows = (STEP_MAS * np.arange(-(r // STEP_MAS), r // STEP_MAS + 1) for r in reach)
        return [self.displaced(x, y) for y in rows for x in columns if np.hypot(x, y) >= INNER_MAS]


class SeveralCopies(OtfEffect):
    """Several copies of one star, each with its flux ratio to the star.

    Parameters
    ----------
    effects : sequence of Effect
        Each a `CopiesOfStar`, some of whose parameters may be held.
    """

    def __init__(self, effects: Sequence[Effect]):
        self.every = tuple(effects)
        self.parameters = tuple(p for one in effects for p in one.parameters)

    def all_of_each(self, values: torch.Tensor) -> list[torch.Tensor]:
        """Return all parameters of every copy from the free ones, `values`."""
        pieces = values.split([len(one.parameters) for one in self.every])
        return [one.all_values(piece) for one, piece in zip(self.every, pieces, strict=True)]


class Companion(CopiesOfStar):
    """Second source with the spectrum of the star, as sharp as the star: a binary, or a chance neighbour.

    The images of both add, ``(1 + f exp(-2πi b·s/λ)) / (1 + f)`` on the OTF. The total light stays; the
    position means nothing without the companion and is scanned in a search.

    Parameters
    ----------
    start : (float, float, float)
        Flux ratio and position [mas].
    """

    name = "companion"
    formula = "T(b) = (1 + f exp(−2πi b·s / λ)) / (1 + f), f = flux_ratio, s at sep_mas, pa_deg"
    belongs_to = "star"
    instrumental = False
    public = (
        number("flux_ratio", "secondary over primary", 0.0, 1.0),
        number("sep_mas", "mas", 0.0, 5000.0, role="position"),
        direction("pa_deg"),
    )
    sentence = "a second source of {flux_ratio:.2%} at {sep_mas:.0f} mas, PA {pa_deg:.0f}°"
    limit = "a companion of {flux_ratio:.1g}"
    look_alike = "vibration when closer than λ/D; a ghost, which other stars have too"
    reference = "Labeyrie 1970, A&A 6, 85"

    def __init__(self, start: tuple[float, float, float] = (0.01, 100.0, 0.0), reach_mas: float = 300.0):
        flux, x, y = start
        self.parameters = (
            Parameter("flux_ratio", "", flux, lower=0.0, upper=1.0, plausible=(0.0, 0.9)),
            Parameter("x_mas", "mas", x, lower=-reach_mas, upper=reach_mas, null=None),
            Parameter("y_mas", "mas", y, lower=-reach_mas, upper=reach_mas, null=None),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> Companion:
        """Within half the window's width of the star on every side."""
        return cls((0.01, conditions.reach_mas / 3, 0.0), conditions.reach_mas)

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        flux, *_ = values
        return factor * (1 + copy_of_star(values, grid)) / (1 + flux)

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        """See `Effect.together`: the images of all add to that of the star."""
        return _Companions(effects)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Flux ratio, separation and position angle."""
        flux, x, y = (float(v) for v in values)
        sep_mas, pa_deg = size_and_angle(x, y)
        return {"flux_ratio": flux, "sep_mas": sep_mas, "pa_deg": pa_deg}

    def values_of(self, flux_ratio: float, sep_mas: float, pa_deg: float) -> list[float]:
        """See `Effect.values_of`."""
        return [flux_ratio, *components(sep_mas, pa_deg)]


class _Companions(SeveralCopies):
    """Several companions of one star."""

    name = Companion.name

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        every = self.all_of_each(values)
        light = 1 + sum((copy_of_star(one, grid) for one in every), torch.zeros(()))
        return factor * light / (1 + sum(one[0] for one in every))


def copy_of_star(values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
    """What a second image adds to the OTF of the star; `values`: flux ratio and place [mas], (3,)."""
    flux, x, y = values
    return flux * phasor(-2 * np.pi * grid.path_m(x * MAS, y * MAS) / grid.wavelengths_m)
