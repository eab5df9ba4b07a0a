"""Stage `ingest`: from the files of the recorder to clean frames in electrons."""

from __future__ import annotations

import json
import re
from dataclasses import MISSING, asdict, dataclass, fields
from math import nan
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.recording import SERIES, Acquisition, Recording
from irlos_pipe.frames.screening import Limits
from irlos_pipe.frames.told import Constant
from irlos_pipe.product.product import Product, Quantity, declared
from irlos_pipe.product.results import DITTO, Number, Observed, ResultsPart, StageResults, item, results_of
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.base import StageConfig, late

VERSION = 14
ARRAYS_ONLY = True
DEPENDS_ON = frozenset({"instrument", "inputs"})
Part = TypeVar("Part", Thresholds, Limits)
ROOT = "recordings"
# Arrays of a recording.
RECORDING = {
    "images_e": ("e-", "frame, y, x", "signal above background"),
    "mean_e": ("e-", "y, x", "mean of the used frames"),
    "raw_adu": ("ADU", "frame, y, x", "counts as recorded"),
    "used": ("", "frame", "whether a frame is used"),
    "reason": ("", "frame", "why a frame is not used"),
    "pixel_mask": ("", "y, x", "whether a pixel is good"),
    "time_s": ("s", "frame", "time since the first frame"),
    "start_unix_s": ("s", "", "time of the first frame since 1970"),
    "frame_counter": ("", "frame", "counter of the recorder"),
    "frames_missing": ("", "", "frames that the recorder lost"),
    "introduced_defocus_nm": ("nm", "frame", "introduced defocus, RMS"),
    "background_adu": ("ADU", "y, x", "subtracted from the counts"),
    "background_variance_e2": ("e-2", "", "variance per pixel beyond read noise and photons of the star"),
    "dark_variance_e2": ("e-2", "", "variance per pixel of the dark image, the same in every frame"),
    "flat": ("", "y, x", "relative response, divided out"),
    "cosmic_hits": ("", "hit, 3", "replaced pixels: frame, row, column"),
    "screened_e": ("e-", "pixel", "mean signal of the pixels in bad_pixels_found, as they were recorded"),
    "acquisition": ("", "", "how it was taken, and where each key came from (JSON)"),
    **SERIES,
}
ARRAYS = {f"{ROOT}/<input>/<name>/{name}": what for name, what in RECORDING.items()}
CHECKS = {
    "rejected": ("part of the frames that cannot be used", "max_rejected_fraction"),
    "saturated": ("part of the frames that are saturated", "max_saturated_fraction"),
    "missing": ("part of the frames that the recorder lost", "max_missing_fraction"),
    "bad_pixels": ("part of the window that is masked", "max_bad_pixel_fraction"),
    "centring": ("distance of the star from the window's centre", "max_centre_offset_fraction"),
    "flux": ("signal of the star above the level of the sky, or dark", ""),
    "told": ("what was declared of the recording and its frames contradict beyond doubt", ""),
}


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


class RecordingRow(ResultsPart):
    """One recording; those of role ``dark`` have only the keys up to `mag_j`."""

    name: str = item("", "Name of the recording, that of its folder or file.")
    input: str = item("", "Recipe input that it belongs to.")
    role: str = item(
        "", "What it was taken for, as the side-car tells: ``ncpa_calibration``, ``defocus_ramp``, …"
    )
    layout: str = item(
        "", "Kind of file that it was read from, ``sparta_recorder``, ``muse_raw``, ``fits_cube`` or ``aot``."
    )
    mode: str = item("", "Read-out mode, empty where the layout has none.")
    frames: int = item(
        0, "All frames recorded, those of them that are not used, and those that the recorder lost."
    )
    window: tuple[int, ...] = item((), "Rows and columns.")
    frames_rejected: int = item(
        0, "All frames recorded, those of them that are not used, and those that the recorder lost."
    )
    frames_missing: int = item(0, DITTO)
    flux_e: Number = item(nan, "Median over the used frames of the sum over the window [e-].")
    mag_j: Number = item(nan, "J magnitude of the star, as declared.")
    reasons: dict[str, int] = item({}, "Rejected frames by reason.")
    saturated_frames: int = item(0, "Frames that are rejected for pixels at the saturation level.")
    bad_pixels: list[tuple[int, int]] = item(
        [], "All masked pixels, and those of them that no map of dead pixels lists."
    )
    bad_pixels_found: list[tuple[int, int]] = item([], DITTO)
    clipped_pixels: list[tuple[int, int]] = item(
        [], "Those of the masked pixels that stop at a level of their own in many frames."
    )
    cosmic_hits: int | None = item(None, "Replaced pixels, over all frames.")
    centre_offset_px: tuple[Number, ...] = item(
        (), "Position (x, y) of the star from the centre of the window."
    )
    pedestal_adu: Number = item(
        nan,
        "Level without light that was estimated from the frames themselves, and its standard error; NaN "
        "where dark images give it.",
    )
    pedestal_error_adu: Number = item(nan, DITTO)
    noise_floor_e2: Number = item(nan, "Noise as measured from the frames; NaN where it cannot be.")
    excess_noise_measured: Number = item(nan, DITTO)
    background_variance_e2: Number = item(
        nan, "Variance per pixel beyond read noise and star, and of the dark image."
    )
    dark_variance_e2: Number = item(nan, DITTO)
    noise: dict[str, Constant] = item({}, "Gain, read noise and excess noise by their side-car key.")
    corner_scatter_e: Number = item(
        nan, "RMS over time of the darkest pixels, stripes and a changing halo included."
    )
    sources: dict[str, str] = item({}, "Where each key of the acquisition came from.")
    observed: Observed = item(Observed(), "What products hand on of it.")
    doubts: list[str] = item([], "What was declared and the frames, or plain sense, put in doubt.")

    @property
    def frames_used(self) -> int:
        """Frames that are not rejected."""
        return self.frames - self.frames_rejected


class IngestResults(StageResults):
    """One row per recording, darks behind."""

    stage: ClassVar[str] = "ingest"
    inputs: list[RecordingRow] = []


Results = IngestResults
run = late("irlos_pipe.stages.ingest.work")
files_of = late("irlos_pipe.stages.ingest.sources", "files_of")
examined = late("irlos_pipe.stages.ingest.sources", "examined")


# -- recordings as arrays of the product, and back ---------------------------------------------------

# Attributes of a recording that are arrays of the product. Those with a default are single numbers, of which
# a product of an earlier version may lack some.
STORED = [one for one in fields(Recording) if one.name not in ("name", "input", "acquisition")]
ACQUISITION = TypeAdapter(Acquisition)  # as it is stored, JSON
CALLED = {one.name: one.name for one in STORED} | {"good": "pixel_mask"}


@dataclass(frozen=True)
class Overview:
    """What a report shows of a recording: attributes of `Recording`, without the frames."""

    name: str
    input: str
    acquisition: Acquisition
    good: np.ndarray
    start_unix_s: float
    mean_e: np.ndarray  # mean of the used frames [e-], (rows, columns)
    used: np.ndarray  # (frames,); `time_s` as well
    time_s: np.ndarray
    series: dict[
        str, np.ndarray
    ]  # see `frames.recording.SERIES`, (frames,) each; empty of an earlier version


def prefix_of(recording: Recording) -> str:
    """Return where a recording lies in the product: ``recordings/<input>/<name>``."""
    return f"{ROOT}/{recording.input}/{recording.name}"


def arrays_from_recording(recording: Recording) -> dict[str, Quantity]:
    """Return everything that a recording holds, and the mean of its frames, as arrays of the product."""
    values = {name: getattr(recording, attribute) for attribute, name in CALLED.items()}
    told = json.dumps(asdict(recording.acquisition), sort_keys=True)
    values |= {"acquisition": np.asarray(told, dtype=object), "mean_e": recording.mean_e}
    return declared(RECORDING, values, below=f"{prefix_of(recording)}/")


def screened_e(product: Product, recording: Recording) -> dict[tuple[int, int], float]:
    """Return what the bad pixels that ingest found in a `recording` of its `product` had shown.

    That is the mean signal [e-] by (row, column).

    Raises `InputDataError` when the product is of an earlier version, which did not keep them.
    """
    rows = results_of(IngestResults, product).inputs
    row = next(row for row in rows if (row.input, row.name) == (recording.input, recording.name))
    if not row.bad_pixels_found:
        return {}
    name = f"{prefix_of(recording)}/screened_e"
    if name not in product.arrays:
        raise InputDataError(f"the {product.stage} product was made by an earlier version; run ingest again")
    return dict(zip(row.bad_pixels_found, product.arrays[name].value.tolist(), strict=True))


def recordings_from_product(product: Product, input: str | None = None) -> list[Recording]:
    """Return the recordings of an ingest `product`, those of one `input` if it is given, as they were read.

    Raises `InputDataError` when there are none.
    """
    recordings = [_recording(product, *key) for key in _keys(product) if input in (None, key[0])]
    if not recordings:
        of_input = "" if input is None else f" of input '{input}'"
        raise InputDataError(f"the {product.stage} product has no recordings{of_input}")
    return recordings


def _keys(product: Product) -> list[tuple[str, str]]:
    """Input and name of every recording, as listed in the results, others behind."""
    listed = [(row.input, row.name) for row in results_of(IngestResults, product).inputs]
    paths = (re.fullmatch(f"{ROOT}/([^/]+)/(.+)/images_e", path, re.DOTALL) for path in product.arrays)
    stored = sorted({(path[1], path[2]) for path in paths if path})
    return [key for key in listed if key in stored] + [key for key in stored if key not in listed]


def _recording(product: Product, owner: str, name: str) -> Recording:
    prefix = f"{ROOT}/{owner}/{name}"
    stored: dict[str, Any] = {}
    for one in STORED:
        array, single = f"{prefix}/{CALLED[one.name]}", one.default is not MISSING
        if array in product.arrays or not single:
            value = product.arrays[array].value
            stored[one.name] = value.item() if single else value
    return Recording(name=name, input=owner, acquisition=_acquisition(product, prefix), **stored)


def overviews_from_product(product: Product) -> list[Overview]:
    """Return what a report shows of the recordings of an ingest product; frames are not read."""
    found = []
    for owner, name in _keys(product):
        prefix = f"{ROOT}/{owner}/{name}"
        arrays = {key: f"{prefix}/{key}" for key in ("pixel_mask", "start_unix_s", "used", "time_s")}
        good, start_s, used, time_s = (np.asarray(product.arrays[path].value) for path in arrays.values())
        mean_e = product.arrays.get(f"{prefix}/mean_e")  # None in a product of an earlier version
        found.append(
            Overview(
                name,
                owner,
                _acquisition(product, prefix),
                good,
                float(start_s),
                mean_e.value if mean_e else _recording(product, owner, name).mean_e,
                used,
                time_s,
                {key: own.value for key in SERIES if (own := product.arrays.get(f"{prefix}/{key}"))},
            )
        )
    return found


def _acquisition(product: Product, prefix: str) -> Acquisition:
    stored = str(product.arrays[f"{prefix}/acquisition"].value)
    try:
        return ACQUISITION.validate_json(stored, extra="forbid")
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, problem["loc"]))
        raise InputDataError(
            f"the {product.stage} product was made by another version ({prefix}: {key}: {problem['msg']}); "
            "run ingest again"
        ) from None
