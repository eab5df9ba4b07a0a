"""What the PSF model has to know of the instrument and of its own sampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import MAS, NM, resolution_px
from irlos_pipe.optics.fourier_matrices import pupil_samples_for

# Beyond the window: of the computed field, and of the period of OTF factors, see `PsfSettings`.
MARGIN_MAS, HALO_MARGIN_MAS = 200.0, 500.0
TUNED_RAD = 1800e-9 / 8.0  # largest λ/D of the images that the margins were tuned on
# Coarser sampling for single frames, whose noise hides the error, see `PsfSettings.for_single_frames`.
FRAME_PUPIL_SAMPLES = 64
FRAME_MARGIN_MAS, FRAME_HALO_MARGIN_MAS = 100.0, 320.0


@dataclass(frozen=True)
class KnownWavefront:
    """What is known of the wavefront before anything is estimated: Noll index to nm RMS."""

    # the astigmatism introduced for phase diversity
    diversity_nm: Mapping[int, float] = field(default_factory=dict)
    # what was introduced on purpose in addition: the defocus commanded of the focus stage
    introduced_nm: Mapping[int, float] = field(default_factory=dict)
    ncpa_nm: Mapping[int, float] = field(default_factory=dict)  # NCPAs estimated before and held here

    @property
    def total_nm(self) -> dict[int, float]:
        """The sum of the three, by Noll index [nm RMS]."""
        total = dict(self.diversity_nm)
        for part in (self.introduced_nm, self.ncpa_nm):
            for noll, nm in part.items():
                total[noll] = total.get(noll, 0.0) + nm
        return total


@dataclass(frozen=True)
class PsfSettings:
    """Everything about the instrument and its sampling that a `PsfModel` needs."""

    geometry: PupilGeometry
    window: tuple[int, int]  # rows and columns of the detector window [px]
    pixel_scale_mas: float
    spectrum: tuple[tuple[float, float], ...]  # photon weights, any positive scale
    known: KnownWavefront  # present in every image, in addition to the coefficients that the model is given
    # samples across the pupil diameter; 128 keeps the error below 1e-4 of the peak for wavefronts up to 600
    # nm RMS (tests/optics/test_psf.py)
    pupil_samples: int = 128
    # field computed beyond the window on each side. The end of the field rings into the window when the
    # intensity is interpolated to the pixels: with 100 mas by 1e-5 of a compact peak and 2e-4 of one spread
    # to the window's edge, with 200 mas by 2e-6 and 5e-5.
    margin_mas: float = MARGIN_MAS
    # the same for the period of the OTF factors, whose wings are wider
    halo_margin_mas: float = HALO_MARGIN_MAS
    # NA / n of the beam in which the focus moves; above 0, Noll 4 stands everywhere for the
    # shape in `optics.focus_table`
    focus_sine: float = 0.0
    # per side of the pupil: 1, or 2 where the window is that of the images of four quarters, see
    # `optics.lenslets`
    lenslets: int = 1

    @property
    def lenslet_window(self) -> tuple[int, int]:
        """Rows and columns of the image of one lenslet; the window without any."""
        rows, columns = self.window
        return rows // self.lenslets, columns // self.lenslets

    @property
    def aperture_m(self) -> float:
        """Width of the part of the pupil that makes an image [m]."""
        return self.geometry.diameter_m / self.lenslets

    @property
    def shortest_m(self) -> float:
        """Shortest wavelength of the spectrum [m]."""
        return min(self.spectrum)[0] * NM

    @property
    def resolution_mas(self) -> float:
        """λ/D at the shortest wavelength [mas]."""
        return self.shortest_m / self.geometry.diameter_m / MAS

    @property
    def mean_nm(self) -> float:
        """Mean wavelength of the photons [nm]."""
        return _joined(self.spectrum)[0]

    @property
    def resolution_px(self) -> float:
        """λ/D at the mean wavelength, D being that of a lenslet if there are several [px]."""
        return resolution_px(self.mean_nm * NM, self.aperture_m, self.pixel_scale_mas)

    @property
    def span_nm(self) -> float:
        """From the shortest wavelength of the spectrum to the longest [nm]."""
        return max(self.spectrum)[0] - min(self.spectrum)[0]

    def with_fewer_colours(self, apart: float) -> PsfSettings:
        """Return the same with neighbouring wavelengths joined, for derivatives that may be rough.

        Light of joined wavelengths falls less than `apart` [λ/D] from each other at the edge of the window.
        """
        reach = max(self.lenslet_window) * self.pixel_scale_mas * MAS / 2 * self.aperture_m  # [m]
        groups: list[list[tuple[float, float]]] = []
        for wavelength_nm, weight in sorted(self.spectrum):
            first_nm = groups[-1][0][0] if groups else 0.0
            near = first_nm and reach / NM * (1 / first_nm - 1 / wavelength_nm) < apart
            if near:
                groups[-1].append((wavelength_nm, weight))
            else:
                groups.append([(wavelength_nm, weight)])
        return replace(self, spectrum=tuple(_joined(group) for group in groups))

    @property
    def breadth(self) -> float:
        """How much larger λ/D is than in the images that the margins were tuned on, at least 1."""
        return max(1.0, max(self.spectrum)[0] * NM / self.aperture_m / TUNED_RAD)

    def for_broad_images(self) -> PsfSettings:
        """Return the settings with the usual margins, wider where λ/D is: light rings that much farther."""
        return replace(
            self,
            margin_mas=MARGIN_MAS * self.breadth,
            halo_margin_mas=HALO_MARGIN_MAS * self.breadth,
        )

    def for_single_frames(self) -> PsfSettings:
        """Return the same light path sampled more coarsely, by an error that the noise of a frame hides.

        With 64 samples across the pupil, images at 1600 nm err by up to 1e-4 of the peak at 142 nm RMS and
        1.3e-3 at 424 nm, where 50 modes fall with their number; ten times as much where all are as
        strong. The defocus of a ramp of ±300 nm with 142 nm of NCPAs errs by less than 0.01 nm, where 10⁶
        photons allow 0.2 nm. A blur wraps around 320 mas beyond the window instead of 500, which moves the
        defocus by less than 0.03 nm at 0.5″. For a mean image this is not enough: χ²/ν of the mean of 60
        noise-limited frames was 1.14 instead of 0.99.
        """
        return replace(
            self,
            margin_mas=min(self.margin_mas, FRAME_MARGIN_MAS * self.breadth),
            halo_margin_mas=min(self.halo_margin_mas, FRAME_HALO_MARGIN_MAS * self.breadth),
            pupil_samples=min(self.pupil_samples, max(FRAME_PUPIL_SAMPLES, self.needed_samples)),
        )

    @property
    def needed_samples(self) -> int:
        """Fewest samples across the pupil for the width of the window."""
        window_px, diameter_m = max(self.lenslet_window), self.geometry.diameter_m
        return pupil_samples_for(window_px, self.pixel_scale_mas, self.shortest_m, diameter_m)


def _joined(group: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Mean wavelength and total weight of some."""
    total = sum(weight for _, weight in group)
    return sum(wavelength_nm * weight for wavelength_nm, weight in group) / total, total
