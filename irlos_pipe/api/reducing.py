"""Single results from images in memory or recordings in files.

Images and keywords become recordings with side-cars, profile and settings in a folder: one way to results.
"""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any
from weakref import finalize

import numpy as np
from astropy.units import Quantity

from irlos_pipe.api.running import Run
from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.files.regular import fits
from irlos_pipe.files.validation import Origins, require_valid
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.frames.recording import Recording
from irlos_pipe.instrument.instrument import MAP_FILE, Instrument, load_instrument, made_profile
from irlos_pipe.instrument.profile import FACTS
from irlos_pipe.pipeline import Resources, Selection, run_recipe
from irlos_pipe.product.product import Product
from irlos_pipe.product.storage import read_product
from irlos_pipe.readers.fitsfile import require_cube
from irlos_pipe.readers.sidecar import AcquisitionKeys, DetectorKeys
from irlos_pipe.recipe import load_recipe
from irlos_pipe.recipe.load import SECTIONS
from irlos_pipe.report.text import plural
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import ModelConfig
from irlos_pipe.stages.ingest.sources import read_sources, with_darks
from irlos_pipe.stages.ingest.stage import Config
from irlos_pipe.stages.ingest.work import ingest

Where = Path | str
Images = Where | np.ndarray | Mapping[str, Any] | Sequence[Where | np.ndarray | Mapping[str, Any]]
IMAGES = ".images"  # in an output folder, of arrays
NEEDED = {  # one of the keys of the side-car, and what to say without
    ("pixel_scale_mas",): "pixel_scale_mas is missing: mas per pixel",
    ("spectrum", "filter_curve"): "wavelength_nm is missing: a wavelength, or {wavelength: weight}",
    ("diversity",): "diversity is missing: what was introduced on purpose, {Noll: nm RMS}, or {}",
}
DEFOCUS = "introduced_defocus_nm"  # of the first input
OWN_LISTS = (DEFOCUS, "spectrum", "filter_curve")  # whose value is a list for one recording
RECORDED = ("wavelength_nm", *AcquisitionKeys.model_fields, *DetectorKeys.model_fields)
COARSEST, NARROWEST = 4.0, 1.0  # λ/D in a pixel at most, and in a window at least: others are another unit
ROLES = {"ramp": "defocus_ramp"}  # by input; others are calibrations
PUPIL = "'circle' or an array with diameter_m, {'diameter_m': 8.0, 'obscuration': 0.14}, or a telescope"
Values = dict[str, Any]


class _Plot:
    """A method ``plot(axes=None)`` of a `Reduction`: a figure of the report, by the stage it is of."""

    def __init__(self, **names: str) -> None:
        self._names = names

    def __get__(self, result: "Reduction | None", kind: object = None) -> Any:
        if result is None:
            return self
        if result.stage not in self._names:
            raise AttributeError(f"a result has this plot where its stage is {' or '.join(self._names)}")
        return partial(result.run.figure, self._names[result.stage])


@dataclass(frozen=True, repr=False)
class Reduction(Product):
    """The product of a stage, and the run that it comes from.

    Its plots are figures of the report, drawn by themselves or on the Matplotlib axes that are given. ``run``
    has all figures, and the products and checks of all stages; without `output` it lasts as long as this.
    """

    run: Run = field(kw_only=True)

    def __repr__(self) -> str:
        """Return what the product shows, and below it the checks of all stages that failed."""
        failed = [f"  FAILED  {one.name}: {one.message}" for one in self.run.checks if not one.passed]
        return "\n".join([super().__repr__(), *failed])

    plot_modes = _Plot(calibrate="cal-ncpa")
    plot_image = _Plot(calibrate="cal-images-logarithmic-0", diagnose="dia-images-logarithmic-0")
    plot_model = _Plot(calibrate="cal-images-logarithmic-1", diagnose="dia-images-logarithmic-1")
    plot_residual = _Plot(calibrate="cal-residual-0-0", diagnose="dia-left-0-0")
    plot_profile = _Plot(calibrate="cal-profile", diagnose="dia-profile")
    plot_wavefront = _Plot(calibrate="wavefront-before")
    plot_ramp = _Plot(lift="ramp")
    plot_chi2 = _Plot(lift="ramp-chi2")


def calibrate(
    *images: Images,
    pixel_scale_mas: float | Sequence[float] | None = None,
    wavelength_nm: float | Mapping[float, float] | Sequence[float | Mapping[float, float]] | None = None,
    diversity: Mapping[int, float] | Sequence[Mapping[int, float]] | None = None,
    pupil: str | Mapping[str, Any] | np.ndarray | None = None,
    settings: Mapping[str, Any] | None = None,
    recipe: Where = "ncpa_calibration",
    output: Where | None = None,
    jobs: int = 1,
    **keywords: Any,
) -> Reduction:
    """Estimate NCPAs from images of one star or source: arrays, or recordings in files.

    ``result.table("noll", "zernike_nm")`` are the modes with their errors; ``plot_modes()``, ``plot_image``,
    ``plot_model``, ``plot_residual``, ``plot_profile`` and ``plot_wavefront`` draw.

    Parameters
    ----------
    *images : ndarray, mapping, Path or str
        Frames (frames, rows, columns) or their mean (rows, columns), in ADU or electrons; or recordings with
        their side-cars. Several, or a list, are fitted together: planes of different diversity, and bands.
        Keywords then have one value, or a list with one for each; ``{"images": array, key: value}`` has keys
        of its own.
    wavelength_nm : float or mapping
        A wavelength [nm], or ``{wavelength: weight}`` of a band.
    diversity : mapping
        Aberration that was introduced on purpose, ``{Noll: nm RMS}``; ``{}`` without one. See `noll_nm`.
    pupil : str, mapping or ndarray
        ``circle``, with the keyword ``diameter_m``; ``vlt``, ``palomar``, ``keck``; a mapping with
        ``diameter_m``, ``obscuration`` (part of the diameter) and ``vanes``, for example
        ``dict(angles_deg=[35, 145], width_m=0.03)``, angles from the axis on, and whatever the section
        `pupil` of a profile takes; or an amplitude map (rows, columns) whose sides are ``diameter_m``, rows
        upwards.
    settings : mapping, optional
        Settings of the `recipe` by dotted key, for example ``{"calibrate.highest_noll": 66}``.
    output : Path or str, optional
        Folder for all products and the report, as ``irlos run`` leaves it; nothing is kept by default.
    **keywords
        Keys of the side-car (``read_noise_e=4``), settings of the stage (``highest_noll=66``), of the model
        (``effects=["tip_tilt_jitter"]``) or of others (``ingest={"min_star_snr": 5}``), facts of the
        telescope (``ao_cutoff_per_m=2.5``), or ``instrument``, a profile instead of `pupil`. Without
        ``seeing_arcsec`` an array with a `pupil` is of an internal source: image motion and no AO residual.

    Raises
    ------
    ConfigurationError
        For keywords and settings.
    InputDataError
        For images that cannot be used.
    """
    own = {"pixel_scale_mas": pixel_scale_mas, "wavelength_nm": wavelength_nm, "diversity": diversity}
    given = own | {"pupil": pupil, "settings": settings, "output": output, "jobs": jobs} | keywords
    return _reduced("calibrate", recipe, {"calibration": list(images)}, given)


def lift(ramp: Images, calibration: Images, *, recipe: Where = "defocus_ramp", **keywords: Any) -> Reduction:
    """Estimate the defocus of every frame of a focus ramp, the NCPAs of a calibration cube known.

    Images, recordings and keywords are those of `calibrate`; the recipe has the inputs ``ramp`` and
    ``calibration`` and the stage `lift`. ``introduced_defocus_nm`` is that of the ramp: a value, or one for
    each of its frames or arrays. A calibration that was recorded otherwise is ``{"images": array,
    "exposure_s": 0.5}``. ``result.table("introduced_nm", "defocus_nm")`` is the ramp; ``plot_ramp`` and
    ``plot_chi2`` draw it.
    """
    return _reduced("lift", recipe, {"ramp": ramp, "calibration": calibration}, keywords)


def diagnose(*images: Images, recipe: Where | None = None, **keywords: Any) -> Reduction:
    """Name what the model of cubes lacks, with size and error.

    Images, recordings and keywords are those of `calibrate`; the recipe has the input ``cube`` and the stage
    `diagnose`. By default it is ``diagnose``, and ``diagnose_bench`` for arrays with a `pupil` and without
    ``seeing_arcsec``; for recordings of an internal source it has to be named.
    ``result.results["sentence"]`` says what was found; ``plot_image``, ``plot_model``, ``plot_residual`` and
    ``plot_profile`` show it.
    """
    return _reduced("diagnose", recipe, {"cube": list(images)}, keywords)


def _reduced(stage: str, recipe: Where | None, inputs: Mapping[str, Any], given: Values) -> Reduction:
    """The product of a stage, and its run in ``output`` or in a folder that goes with it."""
    settings, output, jobs = (given.pop(key, None) for key in ("settings", "output", "jobs"))
    folder = Path(mkdtemp(prefix="irlos-") if output is None else output)
    kept = nullcontext(folder / IMAGES) if output is not None else TemporaryDirectory(prefix="irlos-")
    try:
        with kept as images, _without_paths(Path(images)):
            paths, asked, suitable = prepared(stage, inputs, given, Path(images))
            checked = load_recipe(recipe or suitable, asked | dict(settings or {}), paths)
            last = "correct" if "correct" in checked.stages[: checked.stages.index(stage) + 2] else stage
            resources = Resources(jobs=jobs or 1, report=output is not None)
            run_recipe(checked, folder, Selection(last=last), resources)
        run = Run(folder)
    except BaseException:
        if output is None:
            rmtree(folder, ignore_errors=True)
        raise
    if output is None:
        finalize(run, rmtree, folder, ignore_errors=True)
    return Reduction(**vars(read_product(run.files[stage])), run=run)


@contextmanager
def _without_paths(folder: Path) -> Iterator[None]:
    """Let messages name what the files of a `folder` hold, which nobody has seen."""
    try:
        yield
    except IrlosError as error:
        written = rf"{re.escape(str(folder))}/(\w+)\.(fits|yaml)(:\d+)?"
        text = re.sub(written, r"\1", str(error)).replace(": : ", ": ").replace("pupil: pupil", "pupil")
        raise type(error)(text) from error.__cause__


def prepared(
    stage: str, inputs: Mapping[str, Any], given: Values, folder: Path
) -> tuple[list[str], Values, str]:
    """Return inputs, ``NAME=PATH`` each, settings, and the recipe that suits them.

    Images in memory among the `inputs` of the recipe are written to `folder`; `given` are the keywords of the
    call, among which settings of the `stage` may be.

    Raises `ConfigurationError` for keywords, and `InputDataError` for arrays that cannot be used.
    """
    keywords = {key: plain(value) for key, value in given.items() if value is not None}
    pupil, instrument = given.get("pupil"), keywords.pop("instrument", None)
    keywords.pop("pupil", None)
    acquisition, facts, asked = _sorted(stage, keywords)
    if instrument is not None and (pupil is not None or facts):
        raise ConfigurationError(f"{stage}(): give a pupil with its facts, or an instrument, not both")
    settings: Values = {} if instrument is None else {"instrument": str(instrument)}
    paths: list[str] = []
    arrays: dict[str, tuple[np.ndarray, Values]] = {}  # with their side-cars
    for name, several in inputs.items():
        keys = {k: v for k, v in acquisition.items() if k != DEFOCUS or name == next(iter(inputs))}
        recordings = _recordings(several, keys)
        if not recordings:
            raise ConfigurationError(f"{stage}(): no images; give an array, or the path of a recording")
        for index, one in enumerate(recordings):
            if isinstance(one, (str, Path)):
                paths.append(f"{name}={one}")
                settings |= {f"ingest.acquisition_of.{name}": _sidecar(stage, keys)} if keys else {}
                continue
            title = name if len(recordings) == 1 else f"{name}_{index + 1}"
            own = dict(one) if isinstance(one, Mapping) else {"images": one}
            images, own = own.pop("images", None), keys | plain(own)
            role = {"role": ROLES.get(name, "ncpa_calibration")}
            side = _sidecar(stage, role | own, index, len(recordings))
            for names, meaning in NEEDED.items() if instrument is None else ():
                if not side.keys() & set(names):
                    raise ConfigurationError(f"{stage}(): {meaning}")
            arrays[title] = _cube(images, f"{stage}(): {title}"), side
            paths.append(f"{name}={folder / title}.fits")
    folder.mkdir(parents=True, exist_ok=True)
    for title, (images, side) in arrays.items():
        fits.PrimaryHDU(images).writeto(folder / f"{title}.fits", overwrite=True)
        (folder / f"{title}.yaml").write_text(yaml_text(side))
    inside = bool(arrays) and instrument is None
    if pupil is not None or facts or inside:
        if pupil is None:
            raise ConfigurationError(f"{stage}(): pupil is missing: {PUPIL}")
        content, samples = made_profile(pupil, facts)
        if samples is not None:
            fits.PrimaryHDU(samples).writeto(folder / MAP_FILE, overwrite=True)
        (folder / "pupil.yaml").write_text(yaml_text(plain(content)))
        settings["instrument"] = str(folder / "pupil.yaml")
        diameter_m = load_instrument(settings["instrument"]).pupil.diameter_m
        for images, side in arrays.values():
            _require_units(stage, images.shape[1:], side, diameter_m)
    inside = inside and "seeing_arcsec" not in acquisition
    settings |= {"model.effects": ["tip_tilt_jitter"]} if inside and stage != "diagnose" else {}
    return paths, settings | asked, f"{stage}_bench" if inside else stage


def _sorted(stage: str, given: Values) -> tuple[Values, Values, Values]:
    """Keywords by what they are about: keys of the recordings, facts of the instrument, settings."""
    acquisition, asked, settings = Values(), Values(), Values()
    facts = {"diameter_m": "pupil_diameter_m"} | {key: key for key in FACTS if "pupil" not in key}
    places = {key: f"model.{key}" for key in ModelConfig.model_fields} | {key: key for key in SECTIONS}
    places |= {key: f"{stage}.{key}" for key in STAGES[stage].Config.model_fields if key != "input"}
    for key, value in given.items():
        if key in RECORDED:
            acquisition[key] = value
        elif key in facts:
            asked[facts[key]] = value
        elif key in SECTIONS and isinstance(value, dict):
            settings.update({f"{key}.{inner}": one for inner, one in value.items()})
        elif key in places:
            settings[places[key]] = value
        else:
            known = dict.fromkeys(["pupil", *RECORDED, *facts, *places])
            raise ConfigurationError(f"{stage}(): unknown keyword '{key}'{suggestion(key, known)}")
    return acquisition, asked, settings


def _recordings(several: Any, keys: Values) -> list[Any]:
    """The recordings of an input; images of one window are one, where no key has a value for each."""
    nested = several if isinstance(several, (list, tuple)) else [several]
    found = [one for some in nested for one in (some if isinstance(some, (list, tuple)) else [some])]
    shapes = {one.shape if isinstance(one, np.ndarray) else () for one in found}
    each = any(isinstance(value, list) for key, value in keys.items() if key not in OWN_LISTS)
    return [np.stack(found)] if not each and [len(shape) for shape in shapes] == [2] else found


def _require_units(stage: str, window: Sequence[int], side: Values, diameter_m: float) -> None:
    """Raise ConfigurationError where pixels are too large or too small for units as they are meant."""
    nm = min((float(point["wavelength_nm"]) for point in side.get("spectrum", ())), default=np.nan)
    scale_mas = float(side["pixel_scale_mas"])  # numbers may be text, as in a side-car
    in_pixel = 1 / resolution_px(nm * NM, diameter_m, scale_mas)
    if in_pixel > COARSEST or in_pixel * min(window) < NARROWEST:
        raise ConfigurationError(
            f"{stage}(): pixel_scale_mas = {scale_mas:g} is {in_pixel:.2g} λ/D at {nm:g} nm "
            f"and {diameter_m:g} m, the window {in_pixel * min(window):.2g} λ/D; check the units"
        )


def _sidecar(stage: str, keys: Values, index: int = 0, count: int = 1) -> Values:
    """The side-car of one of several recordings: a key has one value for all, or a list with one for each."""
    side, detector = Values(), Values()
    for key, value in keys.items():
        if key not in RECORDED:
            hint = suggestion(key, ["images", *RECORDED])
            raise ConfigurationError(f"{stage}(): unknown key '{key}'{hint}")
        if isinstance(value, list) and not (key in OWN_LISTS and count == 1):
            if len(value) != count:
                more = "; a spectrum is {wavelength: weight}" if key == "wavelength_nm" else ""
                many = f"{len(value)} values for {plural(count, 'array')} of images{more}"
                raise ConfigurationError(f"{stage}(): {key} has {many}")
            value = value[index]
        if key == "wavelength_nm":
            points = value.items() if isinstance(value, dict) else [(value, 1.0)]
            side["spectrum"] = [{"wavelength_nm": nm, "weight": weight} for nm, weight in points]
        elif key == "diversity" and isinstance(value, dict) and "zernike" not in value:
            side[key] = {"zernike": value}
        else:
            (detector if key in DetectorKeys.model_fields else side)[key] = value
    side |= {"detector": side.get("detector", {}) | detector} if detector else {}
    require_valid(side, AcquisitionKeys, Origins(Path(), {}, [((), f"{stage}()")]))
    return side


def _cube(images: Any, where: str) -> np.ndarray:
    """Images (frames, rows, columns) of a type that FITS has."""
    try:
        masked = isinstance(images, np.ma.MaskedArray)
        array = images.astype(float).filled(np.nan) if masked else np.asarray(images)
    except ValueError:
        raise InputDataError(f"{where}: frames of different shapes") from None
    if array.ndim not in (2, 3):
        raise InputDataError(f"{where}: axes {array.shape or 'none'}, expected (frames, y, x) or (y, x)")
    cube = require_cube(array if array.ndim == 3 else array[None], where)
    if not np.isfinite(cube).any():
        raise InputDataError(f"{where}: no pixel has a finite value")
    kept = cube.dtype.itemsize in (2, 4, 8) and cube.dtype != np.float16
    return cube if kept else cube.astype(np.float64)


def plain(value: Any) -> Any:
    """Return `value` in the types of YAML: NumPy's numbers and arrays become Python's, tuples lists.

    Raises `ConfigurationError` for an Astropy quantity.
    """
    if isinstance(value, Quantity):
        raise ConfigurationError(f"{value}: give plain numbers, their unit is in the name of the keyword")
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {plain(key): plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def read_recordings(
    path: Path | str, instrument: Instrument | str = "irlos", acquisition: Mapping[str, Any] | None = None
) -> list[Recording]:
    """Read and clean the recordings at `path`.

    Parameters
    ----------
    path : Path or str
        A SPARTA recorder folder, MUSE raw file, FITS cube or AOT file, or a folder that contains them.
    instrument : Instrument or str
        The profile, its name, or the path of its file.
    acquisition : mapping, optional
        Keys that win over those of side-cars, for example ``{"role": "psf"}``.

    Returns
    -------
    list of Recording
        ``images_e`` [e-] are (frames, rows, columns); ``used`` says which frames are good.

    Raises `NothingToDo` when there is no recording, `InputDataError` when one cannot be used.
    """
    profile = load_instrument(str(instrument)) if isinstance(instrument, (str, Path)) else instrument
    config = Config(acquisition=AcquisitionKeys.model_validate(acquisition or {}))
    log = logging.getLogger("irlos_pipe")
    sources, _ = read_sources({"recordings": (Path(path),)}, config.keys_for, profile, log)
    return [ingest(source, config, profile)[0] for source in with_darks(sources, log)[0]]
