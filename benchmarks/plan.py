"""Which cases are run, with how many frames and threads, and under which name they are listed."""

from __future__ import annotations

from dataclasses import dataclass

CUBE = 300  # frames of the calibration that all NCPA cases are scaled to


@dataclass(frozen=True)
class Entry:
    """One line of the table.

    Attributes
    ----------
    case : str
        A function of `cases`.
    frames, quick_frames : int
        Frames that are really worked on, by default and with ``--quick``.
    threads : int
        Workers of irlos_pipe.
    gpu : bool
        Run only where PyTorch finds a CUDA device.
    """

    case: str
    label: str
    frames: int
    quick_frames: int
    threads: int = 1
    gpu: bool = False


NCPA = (
    Entry("fft_lbfgs", "padded FFT, autograd, L-BFGS, L1", 12, 3),
    Entry("solvephase_lm", "solvephase, LM per frame, weighted", 60, 3),
    Entry("dip_global", "irlos dip_global, L1", CUBE, 30),
    Entry("dip_global", "irlos dip_global, L1", CUBE, 30, threads=2),
    Entry("lift_slices", "irlos lift_slices, weighted", CUBE, 30),
    Entry("dip_global_cuda", "irlos dip_global, L1, CUDA", CUBE, 30, gpu=True),
)
NCPA_60 = (
    Entry("fft_lbfgs_60", "padded FFT, autograd, L-BFGS, L1", 12, 3),
    Entry("dip_global_60", "irlos dip_global, L1", CUBE, 30),
    Entry("dip_global_60_cuda", "irlos dip_global, L1, CUDA", CUBE, 30, gpu=True),
)
LIFT = (
    Entry("lift_numpy", "NumPy FFT, Gauss-Newton per frame", 7, 2),
    Entry("lift_solvephase", "solvephase, per frame", 7, 3),
    Entry("lift_bare", "irlos lift, the ramp once", 42, 42),
    Entry("lift_bare", "irlos lift, ten realisations", 420, 84),
    Entry("lift_halo", "irlos lift, ten realisations, halo", 420, 84),
    Entry("lift_halo_cuda", "irlos lift, ten realisations, halo, CUDA", 420, 84, gpu=True),
)
OTHERS = (
    Entry("long_exposure", "irlos long_exposure, calibration-sky, 230 modes", 200, 200),
    Entry("long_exposure_cuda", "irlos long_exposure, the same, CUDA", 200, 200, gpu=True),
    Entry("lift_latency", "irlos lift, single frames, 2 wavelengths", 50, 20),
    Entry("sensitivity_scan", "irlos sensitivity scan, 3 and 9 modes, halo", 924, 88, threads=2),
    Entry("model_images", "irlos model, images, 1 wavelength", 480, 64),
    Entry("model_jacobian", "irlos model, images and 29 derivatives", 160, 32),
    Entry("stream_10000", "irlos run, ingest to long_exposure, one cube", 10_000, 600),
)
