"""Stage `ingest`: from the files of the recorder to clean frames in electrons."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import Field

from irlos_pipe.conventions.errors import NothingToDo
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.screening import Limits
from irlos_pipe.instrument.instrument import Instrument
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


class Config(StageConfig):
    """Settings of ingest; every threshold has its unit in its name."""

    acquisition: AcquisitionKeys = Field(
        AcquisitionKeys(), description="side-car keys that win over the side-cars"
    )
    acquisition_of: dict[str, AcquisitionKeys] = Field(
        {}, description="the same for single inputs, by input name; wins over `acquisition`"
    )

    accumulate_s: float | None = Field(
        None, gt=0, le=600, description="raw frames are summed to exposures of this length; longer ones stay"
    )
    accumulate_s_of: dict[str, Annotated[float, Field(gt=0, le=600)]] = Field(
        {}, description="the same for single inputs, by input name; wins over `accumulate_s`"
    )

    bad_pixel_sigma: float = Field(
        8.0, ge=3, le=100, description="deviation from the neighbours over the noise"
    )
    bad_pixel_fraction: float = Field(
        0.07, ge=0.02, le=1, description="the same over the neighbours' brightness"
    )
    stuck_ratio: float = Field(0.3, ge=0, lt=1, description="scatter of a stuck pixel over the read noise")
    noisy_ratio: float = Field(
        5.0, ge=2, le=100, description="scatter of a noisy pixel over the expected one"
    )
    flicker_fraction: float = Field(
        0.05, gt=0, le=1, description="of the frames: a pixel hit more often is bad"
    )

    max_saturated_px: int = Field(0, ge=0, description="saturated pixels tolerated in a frame")
    min_star_snr: float = Field(8.0, ge=3, le=1000, description="peak of the star over the noise")
    min_edge_px: float = Field(2.0, ge=0, le=100, description="distance of the star from the window's edge")
    flux_sigma: float = Field(
        8.0, ge=3, le=100, description="flux outlier: deviation over the robust scatter"
    )
    flux_fraction: float = Field(0.3, gt=0, le=10, description="flux outlier: deviation over the median")
    core_fraction: float = Field(0.1, gt=0, lt=1, description="of the peak: brighter pixels are the core")
    max_core_hits_px: int = Field(4, ge=0, description="hit pixels tolerated in the core; they are replaced")

    max_rejected_fraction: float = Field(0.2, ge=0, le=1, description="QC limit, of the frames")
    max_saturated_fraction: float = Field(0.05, ge=0, le=1, description="QC limit, of the frames")
    max_missing_fraction: float = Field(0.1, ge=0, le=1, description="QC limit, of the frames")
    max_bad_pixel_fraction: float = Field(0.02, ge=0, le=1, description="QC limit, of the window")
    max_centre_offset_fraction: float = Field(
        0.25, gt=0, le=1, description="QC limit, of the smaller window side"
    )

    def thresholds(self) -> Thresholds:
        """Return the thresholds for single pixels."""
        return Thresholds(
            sigma=self.bad_pixel_sigma,
            fraction=self.bad_pixel_fraction,
            stuck_ratio=self.stuck_ratio,
            noisy_ratio=self.noisy_ratio,
            flicker_fraction=self.flicker_fraction,
        )

    def limits(self) -> Limits:
        return Limits(
            saturated_px=self.max_saturated_px,
            star_snr=self.min_star_snr,
            edge_px=self.min_edge_px,
            flux_sigma=self.flux_sigma,
            flux_fraction=self.flux_fraction,
            core_fraction=self.core_fraction,
            core_hits_px=self.max_core_hits_px,
        )

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

    return source_problems(inputs, config.keys_for, instrument)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Read, calibrate and screen every recording of every input."""
    return WORK.run(ctx)
