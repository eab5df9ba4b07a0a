"""The folder of a run made by hand: products with invented numbers, none computed by the package."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from helpers.recordings import recording as made
from irlos_pipe.files.json import jsonable
from irlos_pipe.frames.recording import Detector, Recording
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.storage import write_product
from irlos_pipe.stages.ingest.stage import arrays_from_recording

SIDE = 12
OFFSETS_NM = (-100.0, 100.0, 0.0)
FRAMES = 2  # per offset
NOLLS = (2, 3, 4, 5)
NCPA_NM = {"2": 10.0, "3": -20.0, "4": 30.0, "5": 40.0}
PROVENANCE = {
    "finished": "2024-02-11T05:14:46.123+00:00",
    "seconds": 1.5,
    "device": "cpu",
    "jobs": 1,
    "seed": 7,
    "command": "irlos run recipe.yaml --output out",
    "summary": [],
    "failures": [],
    "files": [],
    "machine": {"host": "wasp", "platform": "Linux"},
    "software": {"irlos_pipe": "0.1.0", "numpy": "2.4.6"},
    "inputs": [{"label": "calibration/sky/sky.fits", "sha256": "0123456789abcdef" * 4}],
}


def star(width_px: float = 2.0) -> np.ndarray:
    """A round star in the middle of the window, its peak at 1000."""
    y, x = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    return 1000 * np.exp(-(x**2 + y**2) / (2 * width_px**2))


def recording(name: str, owner: str, frames: int, introduced_nm: float = 0.0) -> Recording:
    """A recording of identical frames with one masked pixel."""
    mask = np.ones((SIDE, SIDE), bool)
    mask[0, 0] = False
    return made(
        np.repeat(star()[None], frames, axis=0), name, owner, role="psf", good=mask, target="HD 1",
        detector=Detector(2.0, 1.0), introduced_nm=introduced_nm, start_unix_s=1707618000.0,
    )  # fmt: skip


def row(name: str, owner: str, frames: int) -> dict[str, Any]:
    return {
        "name": name,
        "input": owner,
        "role": "psf",
        "frames": frames,
        "frames_rejected": 0,
        "frames_missing": 0,
        "window": [SIDE, SIDE],
        "flux_e": 25000.0,
        "mag_j": 7.0,
        "reasons": {},
        "bad_pixels": [[0, 0]],
        "cosmic_hits": 0,
        "sources": {"derotator_angle_deg": "instrument profile"},
    }


def ingest() -> Product:
    recordings = [recording("sky", "calibration", 4)]
    recordings += [recording(f"offset_{i:02d}", "ramp", FRAMES, nm) for i, nm in enumerate(OFFSETS_NM)]
    arrays = {}
    for one in recordings:
        arrays |= arrays_from_recording(one)
    rows = [row(one.name, one.input, one.frames) for one in recordings]
    return Product(
        "ingest", arrays, {"inputs": rows}, [Check("ingest/rejected", 0.0, "1", None, 0.2, "none")]
    )


def prior() -> Product:
    introduced = np.repeat(OFFSETS_NM, FRAMES)
    arrays = {
        "ratio": Quantity(1 - introduced / 200, ""),
        "defocus_nm": Quantity(introduced, "nm"),
        "introduced_nm": Quantity(introduced, "nm"),
    }
    results = {"A": -200.0, "B": 5.0, "valid_nm": [-150.0, 150.0], "law_residual_nm": 3.0, "estimates": []}
    return Product("prior", arrays, results, config={"input": "ramp"})


def method(name: str, zernike_nm: dict[str, float], seconds: float = 2.0) -> dict[str, Any]:
    return {
        "method": name,
        "zernike_nm": zernike_nm,
        "sigma_nm": dict.fromkeys(zernike_nm, 2.0),
        "wfe_nm": 54.8,
        "frames": 4,
        "seconds": seconds,
        "chi2_nu": 1.07,
        "loss": "gaussian",
        "optimiser": "lm",
        "modes_estimated": 4,
        "status": {"converged": 4},
    }


def calibrate() -> Product:
    values = np.array(list(NCPA_NM.values()))
    frames = values + np.arange(4)[:, None]
    arrays = {
        "noll": Quantity(np.array(NOLLS), ""),
        "zernike_nm": Quantity(values, "nm", error=np.full(4, 2.0)),
        "frames_nm": Quantity(frames, "nm"),
        "mean_image_e": Quantity(star(), "e-", error=np.full((SIDE, SIDE), 5.0)),
        "model_image_e": Quantity(star(2.1), "e-"),
    }
    effects = {
        "seeing_halo": {"wfe_nm": 110.0, "in_band_wfe_nm": 101.0},
        "tip_tilt_jitter": {"sigma_mas": 6.9},
    }
    results = method("long_exposure", NCPA_NM) | {
        "effects": effects,
        "seeing_arcsec": 0.5,
        "compare": [method("dip_avg", {"4": 33.0}, 9.0)],
    }
    return Product(
        "calibrate",
        arrays,
        results,
        [Check("twin solution", 1.0, "", 1.0, None, "the solution")],
        config={"input": "calibration"},
    )


def point(name: str, introduced_nm: float, defocus_nm: float | None) -> dict[str, Any]:
    return {
        "name": name,
        "frame": 0,
        "introduced_nm": introduced_nm,
        "defocus_nm": defocus_nm,
        "sigma_nm": 0.5,
        "converged": True,
        "zernike_nm": {"4": defocus_nm},
    }


TWIN = {"twin_nm": -190.0, "twin_chi2_nu": 48.0, "delta_chi2": 1234.5, "evidence": 1234.5}


def lift() -> Product:
    points = [
        point(f"offset_{i:02d}", nm, nm + 1.0) for i, nm in enumerate(OFFSETS_NM) for _ in range(FRAMES)
    ]
    images = np.repeat(star()[None], len(OFFSETS_NM), axis=0)
    arrays = {
        "offsets_nm": Quantity(np.array(sorted(OFFSETS_NM)), "nm"),
        "measured_per_offset_e": Quantity(images, "e-"),
        "model_per_offset_e": Quantity(0.9 * images, "e-"),
        "curve_defocus_nm": Quantity(np.array([-200.0, 0.0, 200.0]), "nm"),
        "curve_chi2_nu": Quantity(np.array([50.0, 40.0, 0.9]), ""),
    }
    summary = {
        "slope": 0.998,
        "slope_sigma": 0.003,
        "offset_nm": 1.0,
        "rms_nm": 1.2,
        "residual_rms_nm": 0.4,
        "saw_tooth_nm": None,
    }
    results = {
        "modes": [2, 3, 4],
        "calibrated": True,
        "points": points,
        "summary": summary,
        "offsets": [{"introduced_nm": 0.0, "median_nm": 1.0, "scatter_nm": 0.2}],
        "compare": {"without NCPAs": summary | {"slope": 1.234}},
        "twin": {"name": "offset_00", "defocus_nm": 200.0, "chi2_nu": 0.9} | TWIN,
    }
    return Product("lift", arrays, results, config={"input": "ramp"})


def sensitivity() -> Product:
    curve = {
        "calibrated": True,
        "modes": [2, 3, 4],
        "mag_j": [12.0, 14.0, 16.0],
        "median_abs_error_nm": [1.0, 3.0, 9.0],
        "p16_nm": [0.5, 1.0, 4.0],
        "p84_nm": [2.0, 6.0, 20.0],
        "crb_nm": [1.1, 3.3, 10.0],
        "failures": [0, 0, 1],
        "trials": 10,
        "limit_mag": 16.0,
    }
    results = {
        "curves": [curve, curve | {"calibrated": False, "limit_mag": 13.3}],
        "criterion": {"median_abs_error_nm": 30.0, "failures": 0.1},
    }
    return Product("sensitivity", {}, results, config={"input": "ramp"})


def correct() -> Product:
    wavefront = np.where(star() > 1, star() / 10, np.nan)
    radius = np.arange(6) * 9.7
    arrays = {
        "before": Quantity(star() / 1e5, ""),
        "after": Quantity(star(1.5) / 1e5, ""),
        "noll": Quantity(np.array(NOLLS), ""),
        "offset_nm": Quantity(
            -np.array(list(NCPA_NM.values())), "nm", error=np.array([2.0, 2.0, 2.0, np.inf])
        ),
        "radius_mas": Quantity(radius, "mas"),
        "profile_before": Quantity(np.exp(-radius / 20), ""),
        "profile_after": Quantity(np.exp(-radius / 15), ""),
        "wavefront_before_nm": Quantity(wavefront, "nm"),
        "wavefront_after_nm": Quantity(wavefront / 4, "nm"),
    }
    results = {
        "strehl_before": 0.631,
        "strehl_after": 0.742,
        "sign": "offset = -NCPA",
        "strehl_budget": [{"name": "all together", "wfe_nm": 100.0, "alone": 0.631, "without": 1.0}],
        "wavefront_before": {"rms_nm": 103.2, "pv_nm": 733.0},
        "resolution_mas": 41.2,
    }
    return Product("correct", arrays, results, config={"input": "calibration"})


STAGES = {
    "ingest": ingest,
    "prior": prior,
    "calibrate": calibrate,
    "lift": lift,
    "sensitivity": sensitivity,
    "correct": correct,
}


def products(*names: str) -> list[Product]:
    return [STAGES[name]() for name in names or STAGES]


def write_run(folder: Path, made: list[Product], **told: Any) -> Path:
    """Write products and the files around them as a run would; `told` goes into results.json."""
    folder.mkdir(parents=True, exist_ok=True)
    recipe = {"recipe": "made", "title": "A made-up run", "stages": [product.stage for product in made]}
    (folder / "recipe.resolved.yaml").write_text(yaml.safe_dump(recipe))
    for position, product in enumerate(made, 1):
        product.provenance.update(PROVENANCE | product.provenance)
        write_product(product, folder / f"{position:02d}_{product.stage}.h5")
    stages = {product.stage: jsonable(product.results) for product in made}
    results = {"recipe": "made", "status": "ok", "stages": stages} | told
    (folder / "results.json").write_text(json.dumps(results))
    return folder
