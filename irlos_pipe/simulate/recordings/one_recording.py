"""Makes one recording in a folder of its own: expose, read out, write, keep the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.simulate.exposure import exposures
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import layout_of
from irlos_pipe.simulate.recordings.planned import Planned
from irlos_pipe.simulate.recordings.truth import WavefrontTruth, truth_content

DETECTOR_STREAM = 1  # child of the scene's seed; the wavefront has its own


@dataclass(frozen=True)
class Made:
    """A recording that was made.

    Attributes
    ----------
    truth : dict
        Content of its truth file.
    wavefront_fits : bytes
        Its mean wavefront.
    brightest_adu : int
        Highest value of all frames [ADU].
    saturated : int
        Values on the end of the converter.
    """

    truth: dict[str, Any]
    wavefront_fits: bytes
    brightest_adu: int
    saturated: int


def record(planned: Planned, folder: Path, spool: Path, report: Callable[[int], None]) -> Made:
    """Simulate the `planned` recording and write its files into `folder`, which must exist.

    The mean images go to the file `spool` first: the non-linearity is stated at the peak of the
    mean image, which is known only at the end. Memory does not grow with the number of frames.

    Parameters
    ----------
    report : callable
        Called with the number of exposed frames after every frame.
    """
    scene = planned.scene
    wavefront, mean_image_e = WavefrontTruth(scene), np.zeros(scene.window)
    with open(spool, "wb") as stream:
        for index, exposure in enumerate(exposures(scene)):
            stream.write(exposure.mean_e.astype(np.float32).tobytes())
            mean_image_e += exposure.mean_e / scene.frames
            wavefront.add(exposure)
            report(index + 1)
    rng = np.random.default_rng([*scene.seed, DETECTOR_STREAM])
    readout = Readout.of(scene, mean_image_e)
    frames = _Frames(readout, spool, rng)
    layout_of(planned).write(folder, readout, frames, rng)
    spool.unlink()
    content = truth_content(planned, wavefront)
    return Made(content, wavefront.fits_bytes(), frames.brightest_adu, frames.saturated)


class _Frames:
    """Raw frames one by one, from the mean images in `spool`, and how bright they were."""

    def __init__(self, readout: Readout, spool: Path, rng: np.random.Generator):
        self._readout, self._spool, self._rng = readout, spool, rng
        self.brightest_adu, self.saturated = 0, 0

    def __iter__(self) -> Iterator[np.ndarray]:
        for mean_e in self._mean_images():
            frame = self._readout.frames_adu(mean_e, self._rng)
            self.brightest_adu = max(self.brightest_adu, int(frame.max()))
            self.saturated += int((frame >= self._readout.top_adu).sum())
            yield frame

    def _mean_images(self) -> Iterator[np.ndarray]:
        window = self._readout.pedestal_adu.shape
        with open(self._spool, "rb") as stream:
            while (values := np.fromfile(stream, np.float32, window[0] * window[1])).size:
                yield values.reshape(window)
