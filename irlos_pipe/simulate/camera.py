"""Images of a scene's light through its pupil, image motion included.

A matrix DFT leads from the wavefront in the pupil onto points inside the pixels. The image holds no frequency
above D/λ, less than Nyquist's of the pixels, so samples one pixel apart carry its whole spectrum. Motion is a
factor on it, exact but for what comes in over the edge of the window, for which a margin is computed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce

import numpy as np
import scipy.fft
from scipy import ndimage
from scipy.signal import firwin

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import MAS, NM, cutoff_per_px
from irlos_pipe.simulate.aperture import centres, clear_fraction
from irlos_pipe.simulate.light import Ray, mean_centre_nm
from irlos_pipe.simulate.motion import MotionBlur
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope, sum_nm

FINE = 4  # drawn cells per sample and axis
PAD = 4  # samples beyond the diameter on each side, where the low-pass rings
TAPS = 2 * PAD * FINE
KAISER_BETA = 5.0  # of the low-pass window: its stop band is at -53 dB

BATCH = 10  # wavefronts imaged together
SPLINE = 5  # order of the interpolation: errs by less than 1e-5 of the peak below 0.2 cycles per sample
SPLINE_EDGE_PX = 8  # distance from the end of the image beyond which a spline does not notice it
STATIC_NODES = 4  # Gauss–Legendre nodes per pixel and axis
FINEST_CYCLES_PER_PX = 0.4  # highest frequency of an image in whole pixels; above, they are computed in parts
FINEST_DISTORTED = 0.2  # the same where splines interpolate the image
REACH_SIGMAS = 4.0
EDGE_PX = 3  # margin of images in which the discrete transform rings at the border
MIRROR_PX = 8  # mirrored border beyond the margin, so that opposite edges do not mix


@dataclass(frozen=True, eq=False)
class Pupil(Telescope):
    """Pupil on a grid that reaches `PAD` samples beyond the diameter; `geometry` is as built.

    `drawn`, (FINE n, FINE n), is the mean amplitude in the cells of the drawing.
    """

    drawn: np.ndarray

    @property
    def area_m2(self) -> float:
        """Return the clear area; where the pupil is a map, ∫ P² [m²]."""
        if self.geometry.map is None:
            return super().area_m2
        before = replace(self.geometry, obscuration_m=0.0, vanes=(), obstructions=())
        alone = clear_fraction(before, self.drawing_grid_m()[0][0])
        return self.geometry.map.light_m2 * float((self.drawn**2).sum() / (alone**2).sum())

    @cached_property
    def telescope(self) -> Telescope:
        """Return the pupil on the samples across the diameter alone."""
        return Telescope(self.geometry, self.u_m[PAD:-PAD], self.inside(self.transmission))

    def inside(self, opd_nm: np.ndarray) -> np.ndarray:
        """Cut `opd_nm` (..., n, n) to the samples across the diameter."""
        return opd_nm[..., PAD:-PAD, PAD:-PAD]

    def drawing_grid_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates x (1, FINE n) and y (FINE n, 1) of the drawing's cells [m]."""
        fine = centres(len(self.u_m) * FINE, self.step_m / FINE)
        return fine[None, :], fine[:, None]

    def sampled(self, drawn_amplitude: np.ndarray) -> np.ndarray:
        """Return the amplitude at the samples, (n, n), of `drawn_amplitude`, (FINE n, FINE n).

        Edges, vanes and steps are narrower than a sample. Averaged over cells they would blur the image by a
        sample's width; low-passed with a flat pass band, without the frequencies that the samples cannot
        hold, they leave alone what a window of a few tens of λ/D sees.
        """
        low_pass = _low_pass(len(self.u_m))
        return low_pass @ drawn_amplitude @ low_pass.T


def pupil_of(scene: Scene) -> Pupil:
    """Return the pupil at the sampling of a `scene`, with its effects."""
    stops_m = [effect.stop_m for effect in scene.acting("stop_m") if effect.stop_m is not None]
    as_built = reduce(lambda geometry, effect: effect.built(geometry), scene.acting("built"), scene.geometry)
    return _build(as_built, scene.pupil_samples, stops_m[0] if stops_m else None)


@lru_cache(maxsize=8)
def _build(as_built: PupilGeometry, samples: int, stop_m: tuple[float, float] | None) -> Pupil:
    step_m, total = as_built.diameter_m / samples, samples + 2 * PAD
    drawn = clear_fraction(as_built, centres(total * FINE, step_m / FINE), stop_m)
    transmission = drawn.reshape(total, FINE, total, FINE).mean(axis=(1, 3))
    return Pupil(as_built, centres(total, step_m), transmission, drawn)


def amplitude(scene: Scene, pupil: Pupil, wavelength_nm: float, defocus_nm: float = 0.0) -> np.ndarray:
    """Return the amplitude (n, n) in the `pupil` of a `scene`, complex where this light has an own wavefront.

    Such are what depends on `wavelength_nm`, the focus of a ray (`defocus_nm`, Noll 4 beyond that of the
    wavefront, nm RMS), and steps between petals. These lie on the vanes, so they belong to the drawing rather
    than to the smooth wavefront that multiplies the samples.
    """
    transparency: np.ndarray | float = 1.0
    mean_nm, effects = mean_centre_nm(scene.bands), scene.acting("chromatic_zernike_nm")
    chromatic = (effect.chromatic_zernike_nm(wavelength_nm, mean_nm) for effect in effects)
    own_nm = sum_nm([{DEFOCUS: defocus_nm} if defocus_nm else {}, *chromatic])
    if own_nm:
        transparency = np.exp(2j * np.pi / wavelength_nm * pupil.opd_nm(own_nm))
    for effect in scene.acting("transparency"):
        transparency = transparency * effect.transparency(pupil)
    steps = steps_nm(scene, pupil, *pupil.drawing_grid_m())
    if steps is None:
        return transparency * pupil.sampled(pupil.drawn)
    return transparency * pupil.sampled(pupil.drawn * np.exp(2j * np.pi / wavelength_nm * steps))


def steps_nm(scene: Scene, pupil: Pupil, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray | None:
    """Return the wavefront with steps [nm] that effects of the `scene` make; None without such effects.

    It is that at points (`x_m`, `y_m`) of its `pupil`, shapes that broadcast.
    """
    made = (effect.steps_nm(pupil.geometry, x_m, y_m) for effect in scene.acting("steps_nm"))
    given = [steps for steps in made if steps is not None]
    return sum(given[1:], start=given[0]) if given else None


@lru_cache(maxsize=8)
def _low_pass(samples: int) -> np.ndarray:
    """Matrix from the drawing to the samples, (samples, FINE samples); rows sum to 1.

    Flat to half the samples' Nyquist frequency, zero from one and a half: what folds back lands
    beyond the flat part.
    """
    taps = firwin(TAPS, 1 / FINE, window=("kaiser", KAISER_BETA))
    matrix = np.zeros((samples, FINE * samples))
    for index in range(samples):
        first = index * FINE + FINE // 2 - TAPS // 2
        low, high = max(first, 0), min(first + TAPS, FINE * samples)
        matrix[index, low:high] = taps[low - first : high - first]
    return matrix


@dataclass(frozen=True)
class PixelGrid:
    """Pixels about the optical axis, which lies at (N - 1) / 2 of rows and columns."""

    window: tuple[int, int]  # rows and columns [px]
    scale_mas: float  # edge of a pixel
    # of the Gauss–Legendre rule that integrates a pixel, per axis. The image holds no frequency above D/λ,
    # a third of a cycle per pixel of 9.7 mas, for which four nodes err by 1e-7; one is the value at the
    # centre.
    nodes: int = 4

    def node_angles_mas(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions of all nodes along y, (rows * nodes,), and along x, (columns * nodes,) [mas]."""
        inner = np.polynomial.legendre.leggauss(self.nodes)[0] / 2
        y, x = ((centres(size, 1.0)[:, None] + inner).ravel() * self.scale_mas for size in self.window)
        return y, x

    def integrated(self, intensity: np.ndarray) -> np.ndarray:
        """Integral over every pixel [mas²] of the intensity at its nodes, (times, rows, columns) float64."""
        weights = np.polynomial.legendre.leggauss(self.nodes)[1] / 2 * self.scale_mas
        (rows, columns), k = self.window, self.nodes
        return np.einsum("tyjxi,j,i->tyx", intensity.reshape(-1, rows, k, columns, k), weights, weights)


class Imager:
    """Pixel-integrated images.

    ``PSF(a) = |∫ P(u) exp(2πi Φ(u)/λ) exp(-2πi a·u/λ) du|²``, integrated over every pixel.

    The pupil is sampled at `u_m`, (n,), along x and along y [m]; `amplitudes` are real or complex, (n, n),
    for every `Ray.pupil`, and `area_m2` is the clear area that stands for all the star's light. Those of the
    `rays` with the same `Ray.pupil` share the field there.
    """

    def __init__(
        self,
        u_m: np.ndarray,
        amplitudes: Mapping[tuple[float, float], np.ndarray],
        area_m2: float,
        rays: Sequence[Ray],
        pixels: PixelGrid,
        dtype: type = np.complex128,
    ):
        self._dtype, self._pixels = dtype, pixels
        self._real = np.finfo(dtype).dtype
        self._amplitudes = {
            pupil: np.asarray(amplitude, dtype if np.iscomplexobj(amplitude) else self._real)
            for pupil, amplitude in amplitudes.items()
        }
        self._by_pupil: dict[tuple[float, float], list[tuple[Ray, np.ndarray, np.ndarray]]] = {}
        for ray in rays:
            self._by_pupil.setdefault(ray.pupil, []).append((ray, *self._matrices(u_m, ray)))
        # Parseval: the integral of |FT|² over all angles is λ² times the energy in the pupil.
        self._norm = ((u_m[1] - u_m[0]) ** 2 * MAS / NM) ** 2 / area_m2

    def _matrices(self, u_m: np.ndarray, ray: Ray) -> tuple[np.ndarray, np.ndarray]:
        """Fourier matrices (row nodes, n) and (n, column nodes)."""
        y_mas, x_mas = self._pixels.node_angles_mas()
        wavenumber = 2 * np.pi * MAS / (ray.wavelength_nm * NM)
        rows = np.exp(-1j * wavenumber * np.outer(y_mas - ray.offset_mas[1], u_m))
        columns = np.exp(-1j * wavenumber * np.outer(u_m, x_mas - ray.offset_mas[0]))
        return rows.astype(self._dtype), columns.astype(self._dtype)

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return images (times, rows, columns) of wavefronts (times, n, n), in parts of the star's light."""
        batches = np.array_split(opd_nm, max(1, len(opd_nm) // BATCH))
        return np.concatenate([self._batch(np.asarray(batch, self._real)) for batch in batches])

    def _batch(self, opd_nm: np.ndarray) -> np.ndarray:
        intensity = np.zeros((), self._real)
        for pupil, paths in self._by_pupil.items():
            field = self._field(opd_nm, pupil)
            for ray, to_rows, to_columns in paths:
                focal = to_rows @ (field @ to_columns)
                scale = self._real.type(ray.weight * self._norm / ray.wavelength_nm**2)
                intensity = intensity + scale * (focal.real**2 + focal.imag**2)
        return self._pixels.integrated(intensity)

    def _field(self, opd_nm: np.ndarray, pupil: tuple[float, float]) -> np.ndarray:
        phase = opd_nm * self._real.type(2 * np.pi / pupil[0])
        field = np.empty(phase.shape, self._dtype)
        np.cos(phase, out=field.real)
        np.sin(phase, out=field.imag)
        field *= self._amplitudes[pupil]
        return field


@dataclass(frozen=True)
class Distortion:
    """Pixels that look at an image through a linear distortion: splines through a finer image.

    The image is stretched about the optical axis by `stretch`, (2, 2) in (x, y).
    """

    stretch: np.ndarray
    pixels: PixelGrid

    @property
    def reach_px(self) -> int:
        """Return how far beyond the window pixels may look [px]."""
        farthest = np.abs(np.linalg.inv(self.stretch) - np.eye(2)).sum(axis=1).max()
        return int(np.ceil(farthest * max(self.pixels.window) / 2)) + SPLINE_EDGE_PX

    def seen(self, samples: np.ndarray, step_mas: float) -> np.ndarray:
        """Return the light in every pixel, (rows, columns).

        The `samples`, (m, n), are those of the undistorted image about the optical axis, `step_mas` apart,
        each times the square of that distance.
        """
        y_mas, x_mas = self.pixels.node_angles_mas()
        nodes = np.stack(np.meshgrid(x_mas, y_mas)).reshape(2, -1)
        x, y = np.linalg.solve(self.stretch, nodes) / step_mas
        middle = (np.array(samples.shape) - 1) / 2
        places = np.stack([y + middle[0], x + middle[1]])
        light = ndimage.map_coordinates(samples, places, order=SPLINE, mode="mirror") / step_mas**2
        light = light / abs(np.linalg.det(self.stretch))
        return self.pixels.integrated(light.reshape(1, len(y_mas), len(x_mas)))[0]


class Camera:
    """Images of a scene.

    The many images of a frame with an AO residual are sampled at the pixels' centres, in single
    precision, and integrated over the pixels by a factor on the spectrum too; those of a wavefront at
    rest, in double precision, by `STATIC_NODES` points per pixel. Of a distorted image the mean of a frame is
    sampled finer, and the pixels look at that. `motion_mas` is the RMS of the motion that `frame` will be
    asked for, per axis; 0 if it will not.
    """

    def __init__(self, scene: Scene, pupil: Pupil, motion_mas: float = 0.0):
        scale_mas, stretch, rays = scene.pixel_scale_mas, np.eye(2), rays_of(scene)
        for effect in scene.acting("pixel_scale_mas"):
            scale_mas = effect.pixel_scale_mas(scale_mas)
        for effect in scene.acting("stretch"):
            stretch = effect.stretch() @ stretch
        pixels = PixelGrid(scene.window, scale_mas, STATIC_NODES)
        self._distortion = None if np.array_equal(stretch, np.eye(2)) else Distortion(stretch, pixels)
        shortest_m = min(ray.wavelength_nm for ray in rays) * NM
        cycles_per_px = cutoff_per_px(shortest_m, scene.geometry.diameter_m, scale_mas)
        finest = FINEST_DISTORTED if self._distortion else FINEST_CYCLES_PER_PX
        self._parts = max(1, int(np.ceil(cycles_per_px / finest)))
        self._part_mas = scale_mas / self._parts
        self._sampled, self._blurred = scene.moves or self._distortion is not None, motion_mas > 0
        reach_px = int(np.ceil(REACH_SIGMAS * motion_mas / scale_mas))
        self._margin = reach_px + EDGE_PX if self._sampled or self._blurred else 0
        if self._distortion:
            self._margin += self._distortion.reach_px
        rows, columns = (self._parts * (size + 2 * self._margin) for size in scene.window)
        self._imager = Imager(
            pupil.u_m,
            {one: amplitude(scene, pupil, *one) for one in dict.fromkeys(ray.pupil for ray in rays)},
            _build(scene.geometry, scene.pupil_samples, None).area_m2,  # undisturbed, as photometry has it
            rays,
            PixelGrid((rows, columns), self._part_mas, 1 if self._sampled else STATIC_NODES),
            np.complex64 if scene.moves else np.complex128,
        )

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return images of wavefronts `opd_nm` (times, n, n), margin included, as parts of the light."""
        return self._imager.images(opd_nm)

    def frame(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        """Return the mean of `images` at rest, from the method of this name, in motion, (rows, columns).

        `positions_mas`, (times, positions, 2), is where each image is while it is exposed; a single image may
        be given for all times. `blur` is the motion of all images on top.
        """
        if not (self._sampled or self._blurred):
            return self._pixels(images.mean(axis=0))
        image = self._filtered(images, positions_mas, blur)
        light = self._distortion.seen(image, self._part_mas) if self._distortion else self._pixels(image)
        return np.maximum(light, 0.0)  # the filter rings by 1e-8 of the light, about the dark rings of a PSF

    def _filtered(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        border = MIRROR_PX * self._parts
        padded = np.pad(images, ((0, 0), (border, border), (border, border)), mode="symmetric")
        fx = scipy.fft.rfftfreq(padded.shape[2], self._part_mas)
        fy = scipy.fft.fftfreq(padded.shape[1], self._part_mas)
        spectra = scipy.fft.rfft2(padded)
        if positions_mas is not None:
            # a single image takes the positions of all times
            spectra = spectra * transfer(positions_mas.reshape(len(images), -1, 2), fx, fy)
        spectrum = spectra.mean(axis=0) * blur.transfer(fx[None, :], fy[:, None])
        if self._sampled and not self._distortion:
            spectrum *= np.sinc(fx * self._part_mas) * np.sinc(fy * self._part_mas)[:, None]
        return scipy.fft.irfft2(spectrum, s=padded.shape[1:])[border:-border, border:-border]

    def _pixels(self, image: np.ndarray) -> np.ndarray:
        """Sum over the parts of every pixel, without the margin."""
        k, cut = self._parts, slice(self._margin, -self._margin or None)
        whole = image.reshape(image.shape[0] // k, k, image.shape[1] // k, k).sum(axis=(1, 3))
        return whole[cut, cut]


def rays_of(scene: Scene) -> list[Ray]:
    """Return the light of a `scene` with its effects; those on the spectrum keep the number of photons."""
    wavelengths_nm, declared = np.array(scene.spectrum(), float).T
    weights = declared
    for effect in scene.acting("spectrum"):
        wavelengths_nm, weights = effect.spectrum(wavelengths_nm, weights, scene.bands)
    weights = weights * declared.sum() / weights.sum()
    rays = [Ray(*point) for point in zip(wavelengths_nm.tolist(), weights.tolist(), strict=True)]
    for effect in scene.acting("rays"):
        rays = effect.rays(rays)
    return rays


def transfer(positions_mas: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Return the mean of exp(-2πi f·position) at frequencies `fx`, `fy` [1/mas], (times, fy, fx).

    The `positions_mas` are (times, positions, 2).
    """
    along_x = np.exp(-2j * np.pi * positions_mas[:, :, 0, None] * fx)
    along_y = np.exp(-2j * np.pi * positions_mas[:, :, 1, None] * fy)
    return along_y.transpose(0, 2, 1) @ along_x / positions_mas.shape[1]


class LensletCamera:
    """Images of a scene through an array of 2x2 lenslets, a camera behind every quarter of the pupil.

    They lie side by side: lower left and right, upper left and right. `scene`, `pupil` and `motion_mas` are
    as of `Camera`; the pupil is the whole one.
    """

    def __init__(self, scene: Scene, pupil: Pupil, motion_mas: float = 0.0):
        rows, columns = scene.window
        sampling = replace(scene.sampling, pupil_samples=scene.pupil_samples)
        of_one = replace(scene, window=(rows // 2, columns // 2), lenslets=1, sampling=sampling)
        parts = [_quarter(pupil, up, right) for up in (False, True) for right in (False, True)]
        self._cameras = [Camera(of_one, part, motion_mas) for part in parts]
        light = np.array([part.drawn.sum() for part in parts])
        flux = 1 + np.array(scene.lenslet_flux)
        self._flux = flux * light.sum() / (flux @ light)
        self._tilts_nm = pupil.tilts_nm(np.array(scene.lenslet_tilts_mas))

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return images of wavefronts `opd_nm` (times, n, n), (lenslets, times, rows, columns)."""
        pairs = zip(self._cameras, self._tilts_nm.astype(opd_nm.dtype), strict=True)
        return np.stack([camera.images(opd_nm + tilt_nm) for camera, tilt_nm in pairs])

    def frame(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        """Return the mean of `images` in motion, (rows, columns): see `Camera.frame`."""
        parts = [
            flux * camera.frame(own, positions_mas, blur)
            for camera, own, flux in zip(self._cameras, images, self._flux, strict=True)
        ]
        return np.block([parts[:2], parts[2:]])


def _quarter(pupil: Pupil, up: bool, right: bool) -> Pupil:
    """The part of the pupil above or below the axis, and right or left of it: cells do not cross it."""
    x_m, y_m = pupil.drawing_grid_m()
    drawn = pupil.drawn * ((x_m > 0) == right) * ((y_m > 0) == up)
    cells = len(pupil.u_m)
    return replace(pupil, drawn=drawn, transmission=drawn.reshape(cells, FINE, cells, FINE).mean(axis=(1, 3)))


def camera_of(scene: Scene, pupil: Pupil, motion_mas: float) -> Camera | LensletCamera:
    """Return the camera of a `scene`; `pupil` and `motion_mas` are as of `Camera`."""
    kind = Camera if scene.lenslets == 1 else LensletCamera
    return kind(scene, pupil, motion_mas)
