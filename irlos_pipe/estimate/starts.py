"""Where fits begin, and begin again: the centroid, a scan of defocus, single frames, other sides, the twin.

The scan needs no prior: one template per defocus is shared by all images, and the position comes from
the peak of the normalised cross-correlation. It costs a few transforms per image and does not care how
far off the elongation prior is.

Aberrations of 200 nm and more leave an averaged image with several minima, and a fit that starts from
none of them often ends in the wrong one, with χ²/ν several times too large. Single frames keep their
speckles and are less ambiguous; the median of a few of them is a start close enough.

A centro-symmetric pupil gives φ(u) and its twin −φ(−u) the same image. Only the known diversity breaks the
tie. With the diversity's own mode among the estimated ones, the twin is an equally good fit whose even modes,
diversity included, change sign; only what is known of the size of aberrations, the instrument's law of NCPAs,
separates them.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.effects import Effect, EffectSet
from irlos_pipe.effects.base import AT_REST, direction_among
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.pupil_steps import PupilSteps
from irlos_pipe.estimate.calibration_options import LiftOptions, NcpaPrior, TwinCheck
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.image_fit import ImageFit, JoinedFit
from irlos_pipe.estimate.lift import lift
from irlos_pipe.numerics.parallel import at_once, joined_map
from irlos_pipe.numerics.solver import INVALID, Solution, solve
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.light_path import AS_BUILT, LightPath
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.zernike import noll_to_nm

STEP_NM = 100.0  # between templates of a scan of defocus: a fit converges from half of it
SCAN_NM = STEP_NM * np.arange(-7, 8)  # defocus of the templates
ALIKE_AT_ONCE = 8  # images that are compared with all templates at once
SIDES = 4  # directions, evenly about the circle, from which an effect that rests may begin
FEW_FRAMES = 10  # single frames that stand for all: their median is a start, their mean curvature that of all
FEW_FRAMES_ITERATIONS = 60


def start_tilts_nm(images_e: torch.Tensor, settings: PsfSettings) -> torch.Tensor:
    """Return tip and tilt that move the model to the centroid of the bright pixels, (frames, 2) [nm RMS].

    Of `images_e` (frames, rows, columns), pixels below a fifth of the brightest are left out, so that noise
    and halo do not pull.
    """
    if settings.lenslets > 1:  # whose images are one star
        rows, columns = settings.lenslet_window
        images_e = images_e.unflatten(2, (-1, columns)).unflatten(1, (-1, rows)).sum((1, 3))
    bright = (images_e - 0.2 * images_e.amax((1, 2), keepdim=True)).clamp_min(0)
    total = bright.sum((1, 2)).clamp_min(1e-30)
    rows, columns = images_e.shape[1:]
    y = (bright.sum(2) @ (torch.arange(rows).to(bright) - (rows - 1) / 2)) / total
    x = (bright.sum(1) @ (torch.arange(columns).to(bright) - (columns - 1) / 2)) / total
    angles_mas = torch.stack([x, y], dim=1).double().cpu() * settings.pixel_scale_mas
    return tilt_nm(angles_mas, settings.geometry.diameter_m)


def scan_start_nm(
    model: LightPath, images_e: torch.Tensor, good: torch.Tensor, optics: Optics = AS_BUILT
) -> torch.Tensor:
    """Return tip, tilt and defocus of the template that resembles each image most, other modes 0.

    The modes of the `model` include Noll 2, 3 and 4, `optics` is what effects make of the light path. From
    `images_e` (images, rows, columns) and `good` pixels (rows, columns): (images, modes), float64 [nm RMS].
    """
    focus = model.nolls.index(4)
    coefficients = torch.zeros(len(SCAN_NM), len(model.nolls), dtype=torch.float64)
    coefficients[:, focus] = torch.as_tensor(SCAN_NM)
    templates = model.images(coefficients, optics)
    best, shift_px = _most_alike(templates, images_e, good)
    start = torch.zeros(len(images_e), len(model.nolls), dtype=torch.float64)
    start[:, focus] = torch.as_tensor(SCAN_NM)[best]
    pixel_nm = tilt_nm(model.settings.pixel_scale_mas, model.settings.geometry.diameter_m)
    for axis, noll in ((1, 2), (0, 3)):
        start[:, model.nolls.index(noll)] = shift_px[:, axis] * pixel_nm
    return start


def _standardised(images: torch.Tensor) -> torch.Tensor:
    """Images (..., rows, columns) without mean and of unit norm, float32: their correlations are compared."""
    centred = images.float() - images.float().mean((-2, -1), keepdim=True)
    return centred / torch.linalg.vector_norm(centred, dim=(-2, -1), keepdim=True).clamp_min(1e-30)


def _most_alike(
    templates: torch.Tensor, images: torch.Tensor, good: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Template of the highest correlation with each image (images,), and its shift (images, 2) [px]."""
    rows, columns = good.shape
    spectra = torch.fft.rfft2(_standardised(templates)).conj_physical()

    def peaks(some: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        spectrum = torch.fft.rfft2(_standardised((some * good).to(templates.device)))[:, None]
        highest, where = torch.fft.irfft2(spectrum * spectra, s=(rows, columns)).flatten(2).max(2)
        best = highest.argmax(1, keepdim=True)
        at = where.gather(1, best).cpu()
        shifts = [_signed(at // columns, rows), _signed(at % columns, columns)]
        return best[:, 0].cpu(), torch.cat(shifts, dim=1).double()

    best, shifts = joined_map(peaks, images.split(at_once(ALIKE_AT_ONCE, templates.device.type)), len(images))
    return best, shifts


def _signed(index: torch.Tensor, size: int) -> torch.Tensor:
    """Shifts that indices of a circular correlation stand for."""
    return torch.where(index > size // 2, index - size, index)


def evenly(count: int, most: int) -> torch.Tensor:
    """Return numbers of members of so many, spread evenly, `most` of them at most."""
    return torch.linspace(0, count - 1, min(most, count)).round().long()


def median_of_frames_nm(
    model: LightPath, frames: Frames, max_iterations: int = FEW_FRAMES_ITERATIONS
) -> torch.Tensor:
    """Return the median of the coefficients of a few frames spread over a cube, each fitted by itself.

    The first modes of the `model` are Noll 2 and 3, `max_iterations` are those of every fit. Returns float64
    (modes,) [nm RMS], zero where no frame could be fitted.
    """
    some = frames.images_e[evenly(len(frames.images_e), FEW_FRAMES)]
    start = torch.zeros(len(some), len(model.nolls), dtype=torch.float64)
    start[:, :2] = start_tilts_nm((some * frames.good).double(), model.settings)
    options = LiftOptions(noise="data", max_iterations=max_iterations)
    result = lift(ImageModel(model), some, frames.good, frames.noise, start, options)
    valid = torch.tensor([status != INVALID for status in result.solution.status])
    estimates = result.zernike_nm[valid]
    return estimates.median(dim=0).values if len(estimates) else start.new_zeros(len(model.nolls))


def a_wave_off(problem: ImageFit, x: torch.Tensor) -> list[torch.Tensor]:
    """Return starts with one part of the pupil a wave nearer or further, the nearest minima of a broad band.

    At one wavelength they have the same image, in a band an image a little worse than that of the right one:
    a fit that ended there has a wall before it on all sides. The `problem` has one member, whose fit ended at
    `x` (1, parameters).
    """
    wave_nm = problem.model.psf.settings.mean_nm
    first, effects = problem.layout.effect_values.start, problem.model.effects
    pistons = [
        first + effects.columns_of(label)[piston]
        for label, effect in zip(effects.labels, effects.effects, strict=True)
        if isinstance(effect, PupilSteps)
        for piston in effect.pistons
    ]
    found = []
    for column in pistons:
        for sign in (-1, 1):
            start = x.clone()
            start[0, column] += sign * wave_nm
            found.append(start)
    return found


def on_other_sides(
    effects: EffectSet, own: slice, x: torch.Tensor
) -> Iterator[tuple[Effect, torch.Tensor, list[int]]]:
    """Yield starts on another side of an effect with a distance and a direction, to first order degenerate.

    That is the opposite side, and every side where it has come to rest at no distance. The parameters of the
    `effects` are `own` of `x`, (1, parameters). With each start go the effect and its columns.
    """
    for label, effect in zip(effects.labels, effects.effects, strict=True):
        angle = direction_among(effect.parameters)
        if angle is None:
            continue
        columns = [own.start + index for index in effects.columns_of(label)]
        opposite = x[0, columns].numpy().copy()
        opposite[angle] += np.pi
        sides = opposite[None]
        if opposite[0] <= effect.parameters[0].lower + AT_REST:
            starts = {one.name: one.start for one in effect.base.parameters}
            sides = np.tile([starts[one.name] for one in effect.parameters], (SIDES, 1))
            sides[:, angle] = np.arange(SIDES) * 2 * np.pi / SIDES
        for side in sides:
            start = x.clone()
            start[0, columns] = torch.from_numpy(side)
            yield effect, start, columns


def better(first: Solution, second: Solution) -> Solution:
    """Return the one of `first` and `second` with the lower objective; a valid one before an invalid one."""
    if second.status[0] == INVALID or first.status[0] == INVALID:
        return first if second.status[0] == INVALID else second
    return second if second.objective[0] < first.objective[0] else first


def twin_of(modes_nm: torch.Tensor, nolls: Sequence[int], known_nm: Mapping[int, float]) -> torch.Tensor:
    """Return the coefficients, (batch, modes), that give a centro-symmetric pupil the same image [nm].

    The known wavefront in the light path, `known_nm`, does not change.
    """
    twin = modes_nm.clone()
    for column, noll in enumerate(nolls):
        if noll_to_nm(noll)[0] % 2 == 0:
            twin[:, column] = -twin[:, column] - 2 * known_nm.get(noll, 0.0)
    return twin


def check_twin(
    problem: ImageFit | JoinedFit,
    solution: Solution,
    law: NcpaLaw | None,
    known_nm: Mapping[int, float],
    max_iterations: int = 30,
) -> tuple[TwinCheck, Solution]:
    """Refit a `problem` from the twin of its first `solution` and compare; returns the twin as well.

    The `law` is that of the instrument's NCPAs, `known_nm` the known wavefront by Noll index.
    """
    modes, nolls, x = problem.layout.modes, problem.layout.nolls, solution.values[:1]
    start = x.clone()
    start[:, modes] = twin_of(x[:, modes], nolls, known_nm)
    twin = solve(problem, start, max_iterations=max_iterations)
    shape = [i for i, noll in enumerate(nolls) if noll > 3]
    size = [float(v[0, shape].square().sum().sqrt()) for v in (x, twin.values, twin.values - x)]
    delta = 2 * float(twin.objective[0] - float(solution.objective[0]))
    sigma_nm = None if law is None else NcpaPrior(law, 1.0).sigma_nm(nolls)

    def by_prior(at: torch.Tensor) -> float:
        return float((problem.prior_precision[0] * (at[0] - problem.prior_mean[0]).square()).sum())

    def by_law(at: torch.Tensor) -> float:
        return 0.0 if sigma_nm is None else float((at[0, modes] / sigma_nm).square().sum())

    by_data = delta - by_prior(twin.values) + by_prior(x)
    evidence = by_data + by_law(twin.values) - by_law(x)
    return TwinCheck(delta, size[0], size[1], size[2], evidence), twin
