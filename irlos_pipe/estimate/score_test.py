"""Score test: what a candidate effect would do at the optimum of the model without it.

There the derivative of the images with respect to the effect's parameters is the shape D that it would
add. Of D only the part counts that the fitted parameters, with derivatives B, cannot imitate,
``D - B(BᵀB)⁻¹BᵀD``: its norm says how well the effect can be seen, its projection on the residual r how
large it is. One linear step lowers χ² by ``2 s·p - s·N s``, with the sizes s, the projections p and the
normal matrix N (Rao 1948, Proc. Camb. Phil. Soc. 44, 50). Everything is in units of the standard error of
the images; the last word has a fit.

A displaced copy of the star is scored for every shift by whole pixels at once. A companion adds the displaced
image; what it takes from the star the flux makes good. Scalar products of all displaced images with the
residual, with themselves and with the derivatives of the fitted parameters are correlations, done by FFT.

`uneven` asks for an AO residual that is uneven over the pupil, which the modes imitate: whether the scores
``p = Lᵀ r`` of the residual r, with what the fitted parameters leave L of its shapes, are beyond their
covariance V, from their scatter over the frames: ``pᵀ V⁻¹ p`` against χ² of as many scores.

A mirrored image is the image of a mirrored wavefront through a mirrored pupil. Modes follow any wavefront, so
only the pupil shows it. About the fit with the pupil as declared, the mean image is

    I = I_fit + a (I_mirrored − I_fit) + what the parameters follow,

where I_mirrored has the same wavefront behind the mirrored pupil: a is 0 for the pupil as declared, and 1 for
the mirrored one. It is estimated by weighted least squares, without what the fitted parameters would follow;
its error is the scatter of the same estimate over the frames, their autocorrelation included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import placed
from irlos_pipe.conventions.pupil_parts import Placement
from irlos_pipe.effects import Effect, EffectSet, FixedEffect
from irlos_pipe.effects.companion import INNER_MAS
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.planes import CopyOfStar, OtfEffect, PupilEffect
from irlos_pipe.effects.seeing_halo import SeeingHalo, UnevenResidual
from irlos_pipe.estimate.calibration_errors import BY_CHANCE
from irlos_pipe.estimate.cube import LEAST_FRAMES, Frames, autocorrelation_time, covariance_of_mean
from irlos_pipe.estimate.image_fit import Fit, ImageFit
from irlos_pipe.optics.grids import OtfGrid, PupilGrid, PupilMode
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.psf_settings import PsfSettings

ABSORBED = 0.003  # part of a derivative's power below which the fitted parameters imitate the effect
# Of the largest derivative: below it a parameter has no meaning, as a colour of one wavelength.
MEANINGLESS = 1e-9


class NullModel:
    """The optimum of a model without the candidates, whitened.

    The `residual` and one over the standard errors, `root`, are (pixels,); the derivatives of the fitted
    parameters, `basis` (pixels, parameters), are orthonormal, with rows of priors left out. `unconverged`
    (parameters,) is what the derivatives, priors included, have in common with the residual: nothing at the
    very optimum. Of a derivative's power, the parameters may imitate all but `least_seen`. Products of shapes
    with the basis, (parameters, m), are handed over as `inside` where they are known: the basis is long.
    """

    least_seen = ABSORBED

    def __init__(
        self, residual: torch.Tensor, root: torch.Tensor, basis: torch.Tensor, unconverged: torch.Tensor
    ):
        self.residual, self.root, self.basis, self.unconverged = residual, root, basis, unconverged

    def project(self, shapes: torch.Tensor, inside: torch.Tensor | None = None) -> torch.Tensor:
        """What is left of whitened shapes (pixels, m)."""
        return shapes - self.basis @ (self.basis.mT @ shapes if inside is None else inside)

    def norm2(self, shapes: torch.Tensor, inside: torch.Tensor | None = None) -> torch.Tensor:
        """Gram matrix of what is left, priors included, (m, m)."""
        inside = self.basis.mT @ shapes if inside is None else inside
        return shapes.mT @ shapes - inside.mT @ inside

    def projection(self, shapes: torch.Tensor, inside: torch.Tensor | None = None) -> torch.Tensor:
        """Scalar products of the residual with what is left of shapes, (m,)."""
        inside = self.basis.mT @ shapes if inside is None else inside
        return shapes.mT @ self.residual - inside.mT @ self.unconverged


@dataclass(frozen=True, eq=False)
class LinearEstimate:
    """One linear step along the parameters of a candidate."""

    candidate: Effect  # its free parameters at their null values
    usable: torch.Tensor  # (parameters,), those that the data determine
    # part of a derivative's power that the fitted parameters cannot imitate, 1 − R², of the best parameter
    observability: float
    left: torch.Tensor  # (parameters,), power that is left of each derivative
    sizes: np.ndarray  # (parameters,), within the bounds
    gain: float  # predicted fall of χ²
    used: torch.Tensor  # (pixels, m), shapes of the usable parameters
    inside: torch.Tensor  # (basis, m), see `NullModel`
    gram: torch.Tensor  # (m, m), of what is left of them
    normal: torch.Tensor  # (m, m), the same with the priors
    projection: torch.Tensor  # (m,)

    @classmethod
    def of(
        cls, null: NullModel, candidate: Effect, shapes: torch.Tensor, inside: torch.Tensor | None = None
    ) -> LinearEstimate:
        """The estimate of `candidate` jointly with `null`, by whitened derivatives `shapes`, (pixels, m)."""
        inside = null.basis.mT @ shapes if inside is None else inside
        power, gram = (shapes**2).sum(0), null.norm2(shapes, inside)
        left = torch.diagonal(gram)
        seen = left / power.clamp_min(1e-300)
        usable = (power > MEANINGLESS * power.max()) & (seen > null.least_seen)
        sigma = torch.tensor([p.prior_sigma for p in candidate.parameters], dtype=torch.float64)[usable]
        used, inside, gram = shapes[:, usable], inside[:, usable], gram[usable][:, usable]
        normal, projection = gram + torch.diag(sigma**-2), null.projection(used, inside)
        start = torch.tensor(candidate.null_values, dtype=torch.float64)
        change = torch.zeros_like(start)
        change[usable] = torch.linalg.solve(normal, projection)
        limits = torch.tensor([[p.lower, p.upper] for p in candidate.parameters], dtype=torch.float64)
        sizes = (start + change).clamp(limits[:, 0], limits[:, 1])
        step = (sizes - start)[usable]
        gain = float(2 * step @ projection - step @ normal @ step)
        best = float(seen[usable].max() if usable.any() else seen.max())
        return cls(candidate, usable, best, left, sizes.numpy(), gain, used, inside, gram, normal, projection)


def derivatives(
    problem: ImageFit, x: torch.Tensor, frozen: Sequence[Effect], candidate: Effect
) -> torch.Tensor:
    """Derivatives of the mean image with respect to a candidate's parameters at null, (m, pixels).

    The `problem` has one member, with its optimum at `x` (1, parameters), and there the effects `frozen`, see
    `frozen_effects`.
    """
    model, layout = problem.model, problem.layout
    sampling = candidate.plane == "sampling"
    own = model.effects.held(x[0, layout.effect_values]).effects if sampling else frozen
    whole = ImageModel(model.psf, [*own, candidate])
    null = torch.tensor(candidate.null_values, dtype=torch.float64)
    at = x[:, layout.modes], x[:, -2], x[:, -1], null
    columns = whole.predict_and_jacobian(*at, modal=False)[1][0].cpu().double().flatten(1)
    return columns[len(columns) - 2 - len(null) : -2]


# -- where to begin a fit ----------------------------------------------------------------------


def best_start(problem: ImageFit, x: torch.Tensor, effect: Effect) -> FixedEffect:
    """`effect` with all its parameters free, at its best candidate about the optimum `x` of `problem`."""
    settings = problem.model.psf.settings
    null = null_model(problem, x)
    frozen = frozen_effects(problem.model.effects, x[0, problem.layout.effect_values])
    if effect.copies_star:
        star = problem.predict(x)[0].cpu() - x[0, -1]
        candidates: Sequence[Effect] = brightest_copies(
            null, star.reshape(1, *settings.window), settings, effect
        )
    else:
        candidates = effect.candidates(settings.window, settings.pixel_scale_mas)
    estimates = [
        LinearEstimate.of(null, one, (derivatives(problem, x, frozen, one) * null.root).mT)
        for one in candidates
    ]
    best = max(estimates, key=lambda one: one.gain)
    values = best.candidate.all_values(best.sizes).numpy()
    return FixedEffect(effect, values, free=[p.name for p in effect.parameters])


def null_model(problem: ImageFit, x: torch.Tensor) -> NullModel:
    """The optimum of a fit to the mean of a member's images, priors left out."""
    image, columns = problem.predict_and_jacobian(x)
    root = problem.root_weight[0].double().square().mean(0).sqrt().cpu()
    residual = (problem.images[0].double().mean(0) - image[0]).cpu() * root
    basis, _ = orthonormal(columns[0].cpu().double() * root)
    return NullModel(residual, root, basis, basis.mT @ residual)


def orthonormal(
    columns: torch.Tensor, precision: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what whitened derivatives (parameters, pixels) span, with rows of priors, orthonormal.

    That is of the pixels, (pixels, parameters), and of the priors, of a `precision` (parameters,), if any.
    """
    none = columns.new_zeros(len(columns))
    design = torch.cat([columns.mT, torch.diag(none if precision is None else precision.sqrt())])
    size = design.norm(dim=0)  # none of a direction at no distance
    whole = torch.linalg.qr(design / size.clamp_min(1e-300))[0] * (size > 0)
    return whole[: columns.shape[1]], whole[columns.shape[1] :]


# -- copies of the star ----------------------------------------------------------------------------

POSITIONS = 3  # candidates to look at more closely
APART_PX = 4  # distance between two of them, as neighbours of a peak are the same copy
RESOLVED = 1.5  # in λ/D; closer to a known copy another one is not resolved


def brightest_copies(
    null: NullModel,
    stars: torch.Tensor,
    settings: PsfSettings,
    effect: Effect,
    known_mas: Sequence[tuple[float, float]] = (),
) -> list[FixedEffect]:
    """The most promising positions of `effect`, a copy of the star, of any on the pixel grid of the window.

    `stars` are the images of the star where the copy acts, (recordings, rows, columns) [e-], those of the
    model `null`, which has copies at `known_mas` (x, y) already.
    """
    gain, scale = copy_gains(null, stars), settings.pixel_scale_mas
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in gain.shape)
    y, x = (axis * scale for axis in np.meshgrid(rows, columns, indexing="ij"))
    inside = (np.abs(y) < settings.window[0] / 2 * scale) & (np.abs(x) < settings.window[1] / 2 * scale)
    gain[~inside | (np.hypot(x, y) < INNER_MAS)] = 0
    for x_mas, y_mas in known_mas:  # two that cannot be resolved are one that is no copy
        gain[np.hypot(x - x_mas, y - y_mas) < RESOLVED * settings.resolution_mas] = 0
    found = []
    for _ in range(POSITIONS):
        best = np.unravel_index(np.argmax(gain), gain.shape)
        found.append(effect.displaced(x[best], y[best]))
        gain[np.hypot(x - x[best], y - y[best]) < APART_PX * scale] = 0
    return found


def copy_gains(null: NullModel, stars: torch.Tensor) -> np.ndarray:
    """Fall of χ² for every shift (rows, columns), 0 first, of a window of twice the size.

    For `stars` see `brightest_copies`.
    """
    window = stars.shape[1:]
    padded = [2 * n for n in window]

    def correlate(weights: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
        """Correlation of the parts of every recording, summed over the recordings."""
        spectra = [torch.fft.rfft2(one.reshape(-1, *window), s=padded) for one in (weights, images)]
        return torch.fft.irfft2(spectra[0] * spectra[1].conj(), s=padded).sum(0)

    root = null.root
    projection, power = correlate(null.residual * root, stars), correlate(root**2, stars**2)
    imitated = sum(correlate(column * root, stars) ** 2 for column in null.basis.mT)
    left = (power - imitated).clamp_min(1e-3 * power.max())
    return (projection.clamp_min(0) ** 2 / left).numpy()


# -- effects that do not change while candidates are tried ---------------------------------------


class _FrozenTransfer(OtfEffect):
    """OTF factors that do not change while candidates are tried, computed once, with what hangs on them."""

    name = "frozen"

    def __init__(
        self, factor: torch.Tensor, further_paths: Sequence[tuple[PupilMode | None, _FrozenTransfer]] = ()
    ):
        self.factor, self._further_paths = factor, further_paths

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        return self._further_paths

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        return factor * self.factor


class _FrozenCopy(_FrozenTransfer, CopyOfStar):
    """A copy of the star that does not change, with its further defocus."""

    def __init__(self, factor: torch.Tensor, defocus_nm: torch.Tensor):
        super().__init__(factor)
        self._defocus_nm = defocus_nm

    def defocus_nm(self, values: torch.Tensor) -> torch.Tensor:
        return self._defocus_nm


class _FrozenPupil(PupilEffect):
    """An effect in the pupil that does not change, as what it multiplies the field by and what it adds."""

    name = "frozen"

    def __init__(self, effect: Effect, grid: PupilGrid):
        dark = torch.zeros(len(grid.wavelengths_m), *grid.amplitude.shape, dtype=torch.complex128)
        self.order = effect.order
        self.added = effect.apply(NOTHING, dark, grid)
        self.factor = effect.apply(NOTHING, dark + 1, grid) - self.added

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        return field * self.factor + self.added


def frozen_effects(effects: EffectSet, values: torch.Tensor) -> list[Effect]:
    """`effects` held at `values`, computed once; the wavelengths are those that these make."""
    held = effects.held(values)
    optics = held()
    sampling = held.grids.sampling if optics.sampling is None else optics.sampling
    grid = held.grids.pupil.at(sampling.wavelengths_m)
    fixed = [effect for effect in held.effects if effect.plane not in ("pupil", "otf") or effect.joins]
    fixed += [_FrozenPupil(effect, grid) for effect, _ in held.at("pupil") if not effect.joins]
    if optics.transfer is None:
        return fixed
    pairs = zip(optics.copies, held.defocus_nm(NOTHING), strict=True)
    copies = [(None, _FrozenCopy(one.transfer, nm)) for one, nm in pairs if one.transfer is not None]
    by_mode = [(mode, _FrozenTransfer(factor)) for mode, factor in optics.by_mode]
    return [*fixed, _FrozenTransfer(optics.transfer, [*copies, *by_mode])]


def uneven(frames: Frames, fit: Fit) -> UnevenResidual | None:
    """Return the unevenness over the pupil of an AO residual where the images show one.

    The `fit` is that of the mean of the `frames`. There is none where the model has it already or has no AO
    residual, nor where the frames' scatter explains what is seen of it.
    """
    problem, x, effects = fit.problem, fit.x, fit.problem.model.effects
    halos = [
        base for base in (getattr(one, "base", one) for one in effects.effects) if type(base) is SeeingHalo
    ]
    if not halos or UnevenResidual.name in {one.name for one in effects.effects}:
        return None
    halo, null = halos[0], null_model(problem, x)
    found = UnevenResidual(halo.band, halo.law, halo.seeing_arcsec)
    frozen = frozen_effects(effects, x[0, problem.layout.effect_values])
    left = null.project(derivatives(problem, x, frozen, found).mT * null.root[:, None])
    series = frames.responses((left * null.root[:, None]).mT)
    inverse = torch.linalg.inv(torch.as_tensor(covariance_of_mean(series.numpy())))
    score = left.mT @ null.residual
    by_chance = len(score) + BY_CHANCE * np.sqrt(2 * len(score))
    return found if float(score @ inverse @ score) > by_chance else None


SIGNIFICANT = 4.0  # standard errors from which an amplitude counts
MIRROR = Placement(mirrored=True)


@dataclass(frozen=True)
class Mirrored:
    """Amplitude of the mirrored pupil, and its standard error."""

    amplitude: float
    sigma: float

    @property
    def tells(self) -> bool:
        """Whether the error is small enough to distinguish the mirrored pupil from the declared one."""
        return SIGNIFICANT * self.sigma <= 1

    @property
    def limit(self) -> float:
        """Amplitude above which the images are mirrored: nearer to 1, and no chance."""
        return max(0.5, SIGNIFICANT * self.sigma)


def mirrored(frames: Frames, problem: ImageFit, values: torch.Tensor) -> Mirrored | None:
    """Return how much of the mirrored pupil the mean image shows; None where nothing determines it.

    The mean of the `frames` was fitted with `problem`, at `values` (1, parameters).
    """
    if len(frames.images_e) < LEAST_FRAMES:
        return None
    image, jacobian = problem.predict_and_jacobian(values)
    psf = problem.model.psf
    settings = replace(psf.settings, geometry=placed(psf.settings.geometry, MIRROR))
    path = light_path(settings, psf.nolls, device=psf.device, dtype=torch.float64)
    other = problem.with_model(ImageModel(path, problem.model.effects.effects))
    difference = other.predict(values)[0].cpu() - image[0].cpu()
    root = frames.root
    basis, _ = orthonormal(jacobian[0].double().cpu() * root, problem.prior_precision[0].double().cpu())
    along = difference * root
    along = along - basis @ (basis.mT @ along)  # what the parameters do not follow
    length = float(along @ along)
    if not length > 0:
        return None
    deviations = torch.where(root > 0, (frames.sample_e - image[0].cpu()) * root, 0.0)
    amplitudes = (deviations @ along / length).numpy()
    whole = torch.where(root > 0, (frames.mean_e.flatten() - image[0].cpu()) * root, 0.0)
    independent = len(amplitudes) / float(autocorrelation_time(amplitudes[:, None])[0])
    return Mirrored(float(whole @ along / length), float(amplitudes.std(ddof=1) / np.sqrt(independent)))
