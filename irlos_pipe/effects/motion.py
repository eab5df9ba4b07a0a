"""Image motion within an exposure: `tip_tilt_jitter` and `vibration`.

The time average of an image that moves by s(t) has the OTF of the image at rest times the
characteristic function of the motion, ``⟨exp(-2πi b·s/λ)⟩`` (e.g. Goodman 1985, Statistical Optics, §8):
``exp(-w)`` for a Gaussian and ``J0(2√w)`` for a sinusoidal motion, ``w = 2π² σ² b²/λ²`` with σ² the
variance along the baseline. The parameter is the variance, because ∂μ/∂σ vanishes at σ = 0.
"""

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.units import MAS
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, direction
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.numerics.directional import with_pullback
from irlos_pipe.optics.grids import OtfGrid

LARGEST_MAS = 60.0
PLAUSIBLE_MAS2 = (0.0, 40.0**2)
DIRECTIONS = 8
SHAPES = ("sinusoidal", "gaussian")


def _variance(start_mas: float) -> Parameter:
    upper = LARGEST_MAS**2
    return Parameter("variance_mas2", "mas²", start_mas**2, lower=0.0, upper=upper, plausible=PLAUSIBLE_MAS2)


def damping(variance_mas2: Tensor, length2_m2: Tensor, grid: OtfGrid) -> Tensor:
    """Return ``w`` of the module's docstring, for baselines of the squared length `length2_m2`."""
    return 2 * np.pi**2 * MAS**2 * variance_mas2 * length2_m2 / grid.wavelengths_m**2


class TipTiltJitter(OtfEffect):
    """Isotropic Gaussian blur of the image: residual tip-tilt, fast against the exposure.

    A Gaussian object of the same size (the `σ_obj` of LIFT) has the same OTF.
    """

    name = "tip_tilt_jitter"
    formula = "T(b) = exp(−2π² σ² |b|² / λ²), σ = sigma_mas"
    belongs_to = "moment"
    mild = True
    usual = True
    public = (Public("sigma_mas", "mas RMS per axis", 0.0, LARGEST_MAS),)
    blurs = "motion"
    sentence = "image motion of {sigma_mas:.1f} mas RMS per axis"
    look_alike = "interpixel_crosstalk, which does not move the centroids of single frames"
    reference = "Goodman 1985, Statistical Optics, section 8.4"

    def __init__(self, start_mas: float = 7.0):
        self.parameters = (_variance(start_mas),)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        return factor * torch.exp(-damping(values[0], grid.length2_m2, grid))

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        slope = -damping(torch.ones(()), grid.length2_m2, grid) * self.apply(values, factor, grid)
        return [slope for _ in wanted]

    def describe(self, values: np.ndarray) -> dict[str, float]:
        return {"sigma_mas": float(np.sqrt(max(values[0], 0.0)))}

    def values_of(self, sigma_mas: float) -> list[float]:
        return [sigma_mas**2]


class Vibration(OtfEffect):
    """Motion along one line, as resonances of the telescope's structure make it.

    A single line of the vibration spectrum moves the image sinusoidally, many lines together as a
    Gaussian. The direction means nothing without motion and is scanned in a search.

    Parameters: `shape`, one of `SHAPES`.
    """

    name = "vibration"
    formula = (
        "T(b) = J₀(2√2 π σ b∥ / λ), or exp(−2π² σ² b∥² / λ²) with shape gaussian; b∥: baseline along "
        "angle_deg"
    )
    belongs_to = "moment"
    public = (Public("sigma_mas", "mas RMS", 0.0, LARGEST_MAS), direction("angle_deg"))
    options = (Public("shape", "course of the motion", kind="word", choices=SHAPES),)
    blurs = "motion"
    sentence = "a vibration of {sigma_mas:.1f} mas RMS along {angle_deg:.0f}°"
    limit = "a vibration of {sigma_mas:.1f} mas"
    look_alike = "a companion closer than λ/D, which is one-sided; Noll 5 and 6, which have other rings"
    reference = "Goodman 1985, Statistical Optics, section 8.4; lines of UT4 in ERIS telemetry"

    def __init__(self, shape: str = "sinusoidal", start_mas: float = 7.0, start_angle_deg: float = 0.0):
        if shape not in SHAPES:
            raise ValueError(f"the shape of a vibration is sinusoidal or gaussian, not {shape!r}")
        self.shape = shape
        self.parameters = (
            _variance(start_mas),
            Parameter("angle_rad", "rad", np.deg2rad(start_angle_deg), null=None),
        )

    @classmethod
    def variants(cls, conditions: Conditions) -> tuple[Effect, ...]:
        return tuple(cls.under(conditions, shape=shape) for shape in SHAPES)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        along = grid.path_m(torch.cos(values[1]), torch.sin(values[1]))
        w = damping(values[0], along**2, grid)
        own = torch.exp(-w) if self.shape == "gaussian" else j0_of_twice_root(w)
        return factor * own

    def describe(self, values: np.ndarray) -> dict[str, float]:
        angle = float(np.rad2deg(values[1]) % 180)
        return {"sigma_mas": float(np.sqrt(max(values[0], 0.0))), "angle_deg": angle}

    def values_of(self, sigma_mas: float, angle_deg: float) -> list[float]:
        return [sigma_mas**2, float(np.deg2rad(angle_deg))]

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
        return [FixedEffect(self, [0.0, angle], free=("variance_mas2",)) for angle in angles]


def j0_of_twice_root(w: Tensor) -> Tensor:
    """``J0(2√w)`` for w ≥ 0, analytic in w: ``d/dw = -J1(2√w)/√w``, which is -1 at 0."""

    def pullback(w: Tensor, upstream: Tensor) -> Tensor:
        root = torch.sqrt(w)
        safe = torch.where(root > 1e-8, root, 1.0)
        return upstream * torch.where(root > 1e-8, -torch.special.bessel_j1(2 * safe) / safe, -1.0)

    return with_pullback(w, lambda w: torch.special.bessel_j0(2 * torch.sqrt(w)), pullback)
