"""Memory of the loop over very many frames: reads are made up, everything behind them is the loop's own."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
import torch
from threadpoolctl import threadpool_limits

from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
from irlos_pipe.focus.journal import Journal
from irlos_pipe.focus.live import PageSettings
from irlos_pipe.focus.service import LoopSettings, Service

READS, MARKS = 10, 10
MIB = 2**20


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path, exists=True))
@click.option("--frames", default=100_000, show_default=True)
def main(calibration: Path, frames: int) -> None:
    """Print the memory of a loop with the run folder CALIBRATION after every tenth of the FRAMES."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        settings, page = LoopSettings(reads=READS), PageSettings(0)
        source = _MadeUp(frames)
        service = Service(
            Path(folder) / "loop",
            CalibrationRequest(calibration, despite_qc=True),
            settings,
            source.opened,
            page=page,
        )
        records = service.run(lambda _: None)
    print(
        f"{frames} frames, {records} records; MiB after every tenth:", *(f"{one:.1f}" for one in source.mib)
    )


class _MadeUp:
    """Noise around the same star."""

    def __init__(self, frames: int):
        self._left, self._number, self._rng, self.mib = frames, 0, np.random.default_rng(0), list[float]()
        self._mark = math.ceil(frames / MARKS)

    def opened(self, calibration: Calibration, journal: Journal) -> _MadeUp:
        """Take the star from the first image that the sensor models."""
        del journal
        scale = torch.hann_window(calibration.window[0], dtype=torch.float64).numpy() ** 8
        self._star_e = 1e3 * np.outer(scale, scale[: calibration.window[1]])
        return self

    def poll(self, timeout_s: float) -> Sequence[Read] | None:
        if self._number >= self._left:
            return None
        reads = [self._read() for _ in range(READS)]
        if self._number % self._mark == 0:
            self.mib.append(_resident_mib())
        return reads

    def close(self) -> None:
        """See `Source.close`."""

    def _read(self) -> Read:
        self._number += 1
        image_e = self._star_e + self._rng.normal(0, 1, self._star_e.shape)
        return Read(self._number + READS - 1, 1.7e9 + self._number, image_e)


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / MIB


if __name__ == "__main__":
    main()
