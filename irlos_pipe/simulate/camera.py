"""Images of a scene's light through its pupil, image motion included."""

from __future__ import annotations

import numpy as np
import scipy.fft

from irlos_pipe.conventions.units import NM, cutoff_per_px
from irlos_pipe.simulate.distortion import Distortion
from irlos_pipe.simulate.effects.base import LightEffect
from irlos_pipe.simulate.imaging import Imager, PixelGrid
from irlos_pipe.simulate.light import Ray
from irlos_pipe.simulate.motion_blur import MotionBlur
from irlos_pipe.simulate.pupil import Pupil, amplitude, nominal_area_m2
from irlos_pipe.simulate.scene import Scene

STATIC_NODES = 4  # per pixel and axis
FINEST_CYCLES_PER_PX = 0.4  # that the image of a pixel may hold; above, pixels are computed in parts
FINEST_DISTORTED = 0.2  # the same where splines follow the image
REACH_SIGMAS = 4.0
EDGE_PX = 3  # margin for the ringing of the discrete transform at the border
MIRROR_PX = 8  # border beyond the margin that keeps opposite edges apart


class Camera:
    """Images of a scene.

    The image holds no frequency above D/λ, less than Nyquist's of the pixels, so samples one pixel
    apart carry its whole spectrum. Motion is a factor on it, exact but for what comes in over the edge
    of the window, for which a margin is computed.

    The many images of a frame with an AO residual are sampled at the pixels' centres, in single
    precision, and integrated over the pixels by a factor on the spectrum too; those of a wavefront at
    rest, in double precision, by `STATIC_NODES` points per pixel. Of a distorted image the mean of a frame is
    sampled finer, and the pixels look at that.

    Parameters
    ----------
    scene : Scene
    pupil : Pupil
    motion_mas : float
        RMS of the motion that `moved` will be asked for, per axis; 0 if it will not.
    """

    def __init__(self, scene: Scene, pupil: Pupil, motion_mas: float = 0.0):
        scale_mas, rays = true_pixel_scale_mas(scene), rays_of(scene)
        matrix, pixels = stretch_of(scene), PixelGrid(scene.window, scale_mas, STATIC_NODES)
        self._distortion = None if np.array_equal(matrix, np.eye(2)) else Distortion(matrix, pixels)
        self._parts = _parts_per_pixel(
            scale_mas,
            scene.geometry.diameter_m,
            min(ray.wavelength_nm for ray in rays),
            FINEST_DISTORTED if self._distortion else FINEST_CYCLES_PER_PX,
        )
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
            nominal_area_m2(scene),
            rays,
            PixelGrid((rows, columns), self._part_mas, 1 if self._sampled else STATIC_NODES),
            np.complex64 if scene.moves else np.complex128,
        )

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return images of wavefronts `opd_nm` (times, n, n), margin included, as parts of the light."""
        return self._imager.images(opd_nm)

    def frame(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        """Return the mean of images in motion, (rows, columns).

        Parameters
        ----------
        images : ndarray
            Of `images`, at rest.
        positions_mas : ndarray, (times, positions, 2), or None
            Where each image is while it is exposed; a single image may be given for all times.
        blur : MotionBlur
            Motion of all images on top.
        """
        if not (self._sampled or self._blurred):
            return self._pixels(images.mean(axis=0))
        image = self._filtered(images, positions_mas, blur)
        filtered = self._distortion.seen(image, self._part_mas) if self._distortion else self._pixels(image)
        return np.maximum(
            filtered, 0.0
        )  # the filter rings by 1e-8 of the light, about the dark rings of a PSF

    def _filtered(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        border = MIRROR_PX * self._parts
        padded = np.pad(images, ((0, 0), (border, border), (border, border)), mode="symmetric")
        fx = scipy.fft.rfftfreq(padded.shape[2], self._part_mas)
        fy = scipy.fft.fftfreq(padded.shape[1], self._part_mas)
        spectra = scipy.fft.rfft2(padded)
        if positions_mas is not None:
            spectra = spectra * transfer(_shared(positions_mas, len(images)), fx, fy)
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
    effects = scene.acting(LightEffect)
    wavelengths_nm, declared = np.array(scene.spectrum(), float).T
    weights = declared
    for effect in effects:
        wavelengths_nm, weights = effect.spectrum(wavelengths_nm, weights, scene.bands)
    weights = weights * declared.sum() / weights.sum()
    rays = [Ray(*point) for point in zip(wavelengths_nm.tolist(), weights.tolist(), strict=True)]
    for effect in effects:
        rays = effect.rays(rays)
    return rays


def true_pixel_scale_mas(scene: Scene) -> float:
    """Return the pixel scale of a `scene` with its effects."""
    scale_mas = scene.pixel_scale_mas
    for effect in scene.acting(LightEffect):
        scale_mas = effect.pixel_scale_mas(scale_mas)
    return scale_mas


def stretch_of(scene: Scene) -> np.ndarray:
    """Return the matrix by which the image of a `scene` is stretched, in (x, y)."""
    matrix = np.eye(2)
    for effect in scene.acting(LightEffect):
        matrix = effect.stretch() @ matrix
    return matrix


def transfer(positions_mas: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Return the mean of exp(-2πi f·position), (times, fy, fx).

    Parameters
    ----------
    positions_mas : ndarray, (times, positions, 2)
    fx, fy : ndarray, (frequencies,)
        Spatial frequencies [1/mas].
    """
    along_x = np.exp(-2j * np.pi * positions_mas[:, :, 0, None] * fx)
    along_y = np.exp(-2j * np.pi * positions_mas[:, :, 1, None] * fy)
    return along_y.transpose(0, 2, 1) @ along_x / positions_mas.shape[1]


def _shared(positions_mas: np.ndarray, images: int) -> np.ndarray:
    """Positions of every image; a single one takes those of all times."""
    return positions_mas if images == len(positions_mas) else positions_mas.reshape(images, -1, 2)


def _parts_per_pixel(scale_mas: float, diameter_m: float, wavelength_nm: float, finest: float) -> int:
    """Parts of a pixel that hold at most `finest` cycles of the image."""
    cycles_per_px = cutoff_per_px(wavelength_nm * NM, diameter_m, scale_mas)
    return max(1, int(np.ceil(cycles_per_px / finest)))
