"""A wavefront found elsewhere, from which a diagnosis begins as well."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from irlos_pipe.files.regular import read_regular
from irlos_pipe.product.runfolder import RunFolder


def wavefront_of(value: Any) -> Any:
    """Return coefficients as they are, and those in the results of a run for its path.

    Parameters
    ----------
    value : mapping or str
        Noll index to nm RMS, or the path of a run folder or its ``results.json``: of its diagnosis the
        wavefront with what was found, else that of its calibration.

    Raises
    ------
    ValueError
        Where no wavefront can be read.
    """
    if not isinstance(value, str):
        return value
    path = Path(value)
    path = RunFolder(path).results if path.is_dir() else path
    try:
        stages = json.loads(read_regular(path))["stages"]
    except OSError as error:
        raise ValueError(
            f"{path}: {error.strerror or error}; give a run folder or its results.json"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: no results of a run; give a run folder or its results.json") from None
    if "diagnose" in stages and "zernike_nm" in stages["diagnose"]:
        return stages["diagnose"]["zernike_nm"]["after"]
    if "calibrate" in stages:
        return stages["calibrate"]["all_zernike_nm"]
    raise ValueError(f"{path}: no calibration and no diagnosis of a cube; give a run that has one")
