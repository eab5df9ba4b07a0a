"""Stage `ingest`: from the files of the recorder to clean frames in electrons."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field

from irlos_pipe.conventions.errors import NothingToDo
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.screening import Limits
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.results import item
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.ingest.results import ARRAYS, CHECKS
from irlos_pipe.stages.ingest.results import IngestResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "files_of", "problems", "run"]

NAME = "ingest"
VERSION = 13
ARRAYS_ONLY = True
READS = ()
DEPENDS_ON = frozenset({"instrument", "inputs"})
WORK = LateModule("irlos_pipe.stages.ingest.work")
Part = TypeVar("Part", Thresholds, Limits)


class Config(StageConfig):
    """Settings of ingest; every threshold has its unit in its name."""

    acquisition: AcquisitionKeys = item(AcquisitionKeys(), "side-car keys that win over the side-cars")
    acquisition_of: dict[str, AcquisitionKeys] = item(
        {}, "the same for single inputs, by input name; wins over `acquisition`"
    )

    accumulate_s: float | None = item(
        None, "raw frames are summed to exposures of this length; longer ones stay", gt=0, le=600
    )
    accumulate_s_of: dict[str, Annotated[float, Field(gt=0, le=600)]] = item(
        {}, "the same for single inputs, by input name; wins over `accumulate_s`"
    )

    bad_pixel_sigma: float = item(8.0, "deviation from the neighbours over the noise", ge=3, le=100)
    bad_pixel_fraction: float = item(0.07, "the same over the neighbours' brightness", ge=0.02, le=1)
    stuck_ratio: float = item(0.3, "scatter of a stuck pixel over the read noise", ge=0, lt=1)
    noisy_ratio: float = item(5.0, "scatter of a noisy pixel over the expected one", ge=2, le=100)
    flicker_fraction: float = item(0.05, "of the frames: a pixel hit more often is bad", gt=0, le=1)

    max_saturated_px: int = item(0, "saturated pixels tolerated in a frame", ge=0)
    min_star_snr: float = item(8.0, "peak of the star over the noise", ge=3, le=1000)
    min_edge_px: float = item(2.0, "distance of the star from the window's edge", ge=0, le=100)
    flux_sigma: float = item(8.0, "flux outlier: deviation over the robust scatter", ge=3, le=100)
    flux_fraction: float = item(0.3, "flux outlier: deviation over the median", gt=0, le=10)
    core_fraction: float = item(0.1, "of the peak: brighter pixels are the core", gt=0, lt=1)
    max_core_hits_px: int = item(4, "hit pixels tolerated in the core; they are replaced", ge=0)

    max_rejected_fraction: float = item(0.2, "QC limit, of the frames", ge=0, le=1)
    max_saturated_fraction: float = item(0.05, "QC limit, of the frames", ge=0, le=1)
    max_missing_fraction: float = item(0.1, "QC limit, of the frames", ge=0, le=1)
    max_bad_pixel_fraction: float = item(0.02, "QC limit, of the window", ge=0, le=1)
    max_centre_offset_fraction: float = item(0.25, "QC limit, of the smaller window side", gt=0, le=1)

    def part(self, kind: type[Part]) -> Part:
        """Return the settings that a dataclass `kind` of science, `Thresholds` or `Limits`, holds."""
        return kind(**{one.name: getattr(self, one.name) for one in fields(kind)})

    def exposure_of(self, input_name: str) -> float | None:
        """Return the length to which frames of an input are summed [s]; None leaves them as they are."""
        return self.accumulate_s_of.get(input_name, self.accumulate_s)

    def keys_for(self, input_name: str) -> AcquisitionKeys:
        """Return what the recipe says about an input."""
        own = self.acquisition_of.get(input_name, AcquisitionKeys())
        return self.acquisition.updated(own)


def files_of(root: Path) -> list[Path]:
    """Return every file that ingest reads of an input, given as a file or folder `root`."""
    from irlos_pipe.readers.find import files_of as recording_parts
    from irlos_pipe.readers.find import recording_files

    with suppress(NothingToDo):
        return [path for recording in recording_files([root]) for path in recording_parts(recording)]
    return []


def problems(inputs: Mapping[str, Sequence[Path]], config: Config, instrument: Instrument) -> list[str]:
    """Return a line for everything that is wrong with the recordings of `inputs` and their side-cars."""
    from irlos_pipe.stages.ingest.sources import source_problems

    return source_problems(inputs, config.keys_for, instrument, config.exposure_of)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Read, calibrate and screen every recording of every input."""
    return WORK.run(ctx)
