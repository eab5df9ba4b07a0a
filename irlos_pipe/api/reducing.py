"""Single results from images in memory or recordings in files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any
from weakref import finalize

import numpy as np

from irlos_pipe.api.images import prepared
from irlos_pipe.api.running import Run
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.pipeline import Resources, Selection, run_recipe
from irlos_pipe.product.product import Product
from irlos_pipe.recipe import load_recipe

Where = Path | str
Settings = Mapping[str, Any]
Images = Where | np.ndarray | Mapping[str, Any] | Sequence[Where | np.ndarray | Mapping[str, Any]]
IMAGES = ".images"  # in an output folder, of arrays


class _Plot:
    """A method ``plot(axes=None)`` of a `Reduction`: a figure of the report, by the stage it is of."""

    def __init__(self, **names: str) -> None:
        self._names = names

    def __get__(self, result: Reduction | None, kind: object = None) -> Any:
        if result is None:
            return self
        if result.stage not in self._names:
            raise AttributeError(f"a result has this plot where its stage is {' or '.join(self._names)}")
        return partial(result.run.figure, self._names[result.stage])


@dataclass(frozen=True, repr=False)
class Reduction(Product):
    """The product of a stage, and the run that it comes from.

    Its plots are figures of the report, drawn by themselves or on the Matplotlib axes that are given; ``run``
    has all of them: ``result.run.figure(name, axes)``, ``result.run.figures()``.

    Attributes
    ----------
    run : Run
        Products of all stages by name, checks and figures; without `output` they last as long as this object.
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
    settings: Settings | None = None,
    recipe: Where = "ncpa_calibration",
    output: Where | None = None,
    jobs: int = 1,
    **keywords: Any,
) -> Reduction:
    """Estimate NCPAs from images of one star or source: arrays, or recordings in files.

    Parameters
    ----------
    *images : ndarray, Path or str
        Frames (frames, rows, columns), or their mean (rows, columns), in ADU or electrons, dark subtracted or
        not; or recordings with their side-cars. Several, or a list, are fitted together: planes of different
        focus or diversity, and bands. Each keyword then has one value for all, or a list with one for each.
        ``{"images": array, key: value}`` is an array with keys of its own.
    pixel_scale_mas : float
        Pixel scale [mas].
    wavelength_nm : float or mapping
        Wavelength [nm], or ``{wavelength: weight}`` of a band.
    diversity : mapping
        Aberration that was introduced on purpose, ``{Noll: nm RMS}``; ``{}`` without one. See `noll_nm`.
    pupil : str, mapping or ndarray
        ``circle``, with the keyword ``diameter_m``; ``vlt``, ``palomar``, ``keck``; ``{"diameter_m": 4.2,
        "obscuration": 0.29, "vanes": {"angles_deg": [35, 145], "width_m": 0.03}}``, where the obscuration is
        a part of the diameter and vanes begin at the axis, and whatever the section `pupil` of a profile
        takes; or an amplitude map (rows, columns) whose sides are ``diameter_m``, rows upwards.
    settings : mapping, optional
        Settings that differ from the recipe's, for example ``{"calibrate.highest_noll": 66}``.
    recipe : Path or str
        Name or path of a recipe with the input ``calibration`` and the stage `calibrate`.
    output : Path or str, optional
        Folder for all products and the report, as ``irlos run`` leaves it; nothing is kept by default.
    jobs : int
        Number of threads.
    **keywords
        Keys of the side-car (``e_per_adu=2.1``, ``read_noise_e=4``, ``exposure_s=0.1``), settings of the
        stage (``highest_noll=66``), of the model (``effects=["tip_tilt_jitter"]``) or of another section
        (``ingest={"min_star_snr": 5}``), facts of the telescope (``ao_cutoff_per_m=2.5``), or
        ``instrument``, a profile instead of `pupil`. Without ``seeing_arcsec`` an array with a `pupil` is of
        an internal source: image motion and no AO residual.

    Returns
    -------
    Reduction
        Of the stage `calibrate`; ``result.table("noll", "zernike_nm")`` are the modes with their errors, and
        ``result.plot_modes()``, ``plot_image``, ``plot_model``, ``plot_residual``, ``plot_profile`` and
        ``plot_wavefront`` draw, also on Matplotlib axes that are given.

    Raises
    ------
    ConfigurationError, InputDataError
        When a keyword, a setting, an array or a recording cannot be used.
    """
    own = {"pixel_scale_mas": pixel_scale_mas, "wavelength_nm": wavelength_nm, "diversity": diversity}
    given = own | {"pupil": pupil} | keywords
    return _reduced("calibrate", recipe, {"calibration": list(images)}, given, settings, output, jobs)


def lift(
    ramp: Images,
    calibration: Images,
    *,
    settings: Settings | None = None,
    recipe: Where = "defocus_ramp",
    output: Where | None = None,
    jobs: int = 1,
    **keywords: Any,
) -> Reduction:
    """Estimate the defocus of every frame of a focus ramp, the NCPAs of a calibration cube known.

    Parameters
    ----------
    ramp, calibration : ndarray, mapping, Path or str
        Images or recordings, and keywords, as in `calibrate`. ``introduced_defocus_nm`` is that of the ramp:
        a value, or one for each of its frames or arrays. A calibration that was recorded otherwise is given
        as ``{"images": array, "exposure_s": 0.5}``.
    settings, recipe, output, jobs, **keywords
        As in `calibrate`; for example ``modes=[2, 3, 4, 5, 6]``. The recipe has the inputs ``ramp`` and
        ``calibration`` and the stage `lift`.

    Returns
    -------
    Reduction
        Of the stage `lift`; ``result.table("introduced_nm", "defocus_nm")`` is the ramp, and
        ``result.plot_ramp()`` and ``plot_chi2`` draw it.

    Raises
    ------
    ConfigurationError, InputDataError
        When a keyword, a setting, an array or a recording cannot be used.
    """
    inputs = {"ramp": ramp, "calibration": calibration}
    return _reduced("lift", recipe, inputs, keywords, settings, output, jobs)


def diagnose(
    *images: Images,
    settings: Settings | None = None,
    recipe: Where | None = None,
    output: Where | None = None,
    jobs: int = 1,
    **keywords: Any,
) -> Reduction:
    """Name what the model of cubes lacks, with size and error.

    Parameters
    ----------
    *images : ndarray, Path or str
        Images or recordings, and keywords, as in `calibrate`.
    recipe : Path or str, optional
        ``diagnose`` for cubes taken on sky, ``diagnose_bench`` for those of an internal source, or the path
        of a recipe with the input ``cube`` and the stage `diagnose`. By default ``diagnose``, and
        ``diagnose_bench`` for arrays with a `pupil` and without ``seeing_arcsec``.
    settings, output, jobs, **keywords
        As in `calibrate`.

    Returns
    -------
    Reduction
        Of the stage `diagnose`; ``result.results["sentence"]`` says what was found, and
        ``result.plot_image()``, ``plot_model``, ``plot_residual`` and ``plot_profile`` show it.

    Raises
    ------
    ConfigurationError, InputDataError
        When a keyword, a setting, an array or a recording cannot be used.
    """
    return _reduced("diagnose", recipe, {"cube": list(images)}, keywords, settings, output, jobs)


def _reduced(
    stage: str,
    recipe: Where | None,
    inputs: Mapping[str, Any],
    given: Settings,
    settings: Settings | None,
    output: Where | None,
    jobs: int,
) -> Reduction:
    """The product of a stage, and its run in `output` or in a folder that goes with it."""
    folder = Path(mkdtemp(prefix="irlos-") if output is None else output)
    kept = nullcontext(folder / IMAGES) if output is not None else TemporaryDirectory(prefix="irlos-")
    try:
        with kept as images, _without_paths(Path(images)):
            read = prepared(stage, inputs, given, Path(images))
            checked = load_recipe(recipe or read.recipe, read.settings | dict(settings or {}), read.inputs)
            last = "correct" if "correct" in checked.stages[: checked.stages.index(stage) + 2] else stage
            run_recipe(checked, folder, Selection(last=last), Resources(jobs=jobs), report=output is not None)
        run = Run(folder)
    except BaseException:
        if output is None:
            rmtree(folder, ignore_errors=True)
        raise
    if output is None:
        finalize(run, rmtree, folder, ignore_errors=True)
    product = run.read(stage)
    return Reduction(**{one.name: getattr(product, one.name) for one in fields(Product)}, run=run)


@contextmanager
def _without_paths(folder: Path) -> Iterator[None]:
    """Let messages name what the files of a `folder` hold, which nobody has seen."""
    try:
        yield
    except IrlosError as error:
        written = rf"{re.escape(str(folder))}/(\w+)\.(fits|yaml)(:\d+)?"
        plain = re.sub(written, r"\1", str(error)).replace(": : ", ": ").replace("pupil: pupil", "pupil")
        raise type(error)(plain) from error.__cause__
