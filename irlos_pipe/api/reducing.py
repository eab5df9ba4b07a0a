"""Single results from recordings, without a run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from irlos_pipe.pipeline import Resources, Selection, plan_run
from irlos_pipe.pipeline.execution import Job
from irlos_pipe.product.product import Product
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import load_recipe

Where = Path | str
Settings = Mapping[str, Any]


def calibrate(
    *cubes: Where, settings: Settings | None = None, recipe: Where = "ncpa_calibration", jobs: int = 1
) -> Product:
    """Estimate NCPAs from cubes of short narrow-band exposures.

    Parameters
    ----------
    *cubes : Path or str
        Recordings, with their side-cars; several are fitted together.
    settings : mapping, optional
        Settings that differ from the recipe's, for example ``{"calibrate.highest_noll": 66}``.
    recipe : Path or str
        Name or path of a recipe with the input ``calibration`` and the stage `calibrate`.
    jobs : int
        Number of threads.

    Returns
    -------
    Product
        Of the stage `calibrate`; ``product.table("noll", "zernike_nm")`` are the modes with their errors.

    Raises
    ------
    ConfigurationError, InputDataError
        When a setting or a recording cannot be used.
    """
    return _reduced("calibrate", recipe, {"calibration": cubes}, settings, jobs)


def lift(
    ramp: Where,
    calibration: Where,
    *,
    settings: Settings | None = None,
    recipe: Where = "defocus_ramp",
    jobs: int = 1,
) -> Product:
    """Estimate the defocus of every frame of a focus ramp, the NCPAs of a calibration cube known.

    Parameters
    ----------
    ramp, calibration : Path or str
        Recordings, with their side-cars.
    settings : mapping, optional
        Settings that differ from the recipe's, for example ``{"lift.modes": [2, 3, 4, 5, 6]}``.
    recipe : Path or str
        Name or path of a recipe with these inputs and the stage `lift`.
    jobs : int
        Number of threads.

    Returns
    -------
    Product
        Of the stage `lift`; ``product.table("introduced_nm", "defocus_nm")`` is the ramp.

    Raises
    ------
    ConfigurationError, InputDataError
        When a setting or a recording cannot be used.
    """
    return _reduced("lift", recipe, {"ramp": (ramp,), "calibration": (calibration,)}, settings, jobs)


def diagnose(
    *cubes: Where, settings: Settings | None = None, recipe: Where = "diagnose", jobs: int = 1
) -> Product:
    """Name what the model of cubes lacks, with size and error.

    Parameters
    ----------
    *cubes : Path or str
        Recordings, with their side-cars.
    settings : mapping, optional
        Settings that differ from the recipe's.
    recipe : Path or str
        ``diagnose`` for cubes taken on sky, ``diagnose_bench`` for those of an internal source, or the path
        of a recipe with the input ``cube`` and the stage `diagnose`.
    jobs : int
        Number of threads.

    Returns
    -------
    Product
        Of the stage `diagnose`; ``product.results["sentence"]`` says what was found.

    Raises
    ------
    ConfigurationError, InputDataError
        When a setting or a recording cannot be used.
    """
    return _reduced("diagnose", recipe, {"cube": cubes}, settings, jobs)


def _reduced(
    stage: str, recipe: Where, inputs: Mapping[str, Sequence[Where]], settings: Settings | None, jobs: int
) -> Product:
    """The product of a stage; those of the stages before it are forgotten."""
    given = [f"{name}={path}" for name, paths in inputs.items() for path in paths]
    changed = [f"{key}={json.dumps(value)}" for key, value in (settings or {}).items()]
    checked = load_recipe(recipe, changed, given)
    with TemporaryDirectory(prefix="irlos-") as folder:
        files, steps = plan_run(checked, Path(folder), Selection(last=stage))
        Job(checked, Path(folder), files, steps, Resources(jobs=jobs)).perform()
        return read_product(next(step.path for step in steps if step.name == stage))
