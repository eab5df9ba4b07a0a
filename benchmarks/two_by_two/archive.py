"""A simulated archive of raw files in 2x2 modes, reduced, and its defocus beside the truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.plan import Selection
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.recordings.run import simulate
from irlos_pipe.simulate.recordings.spec import load_spec

OLD, NEW = "2020-02-11", "2023-07-14"
# scale and gain of the mode; e-/ADU and read noise of the day, in units of the profile
DETECTORS = {
    OLD: {"e_per_adu": 3.0, "read_noise_e": 11.0, "excess_noise_factor": 1.25},
    NEW: {"e_per_adu": 9.8 / 68, "read_noise_e": 1.0, "excess_noise_factor": 1.25},
}
WANTED_NM, OF_BOUND = 10.0, 1.2


@dataclass(frozen=True)
class File:
    """One file of the archive: what was put in, frames that were used, and what came out [nm]."""

    name: str
    mode: str
    day: str
    mag_j: float
    frames: int
    seeing_arcsec: float
    used: int = 0
    truth_nm: float = float("nan")
    defocus_nm: float = float("nan")
    sigma_nm: float = float("nan")
    bound_nm: float = float("nan")
    centroids_nm: float = float("nan")
    chi2_nu: float = float("nan")

    @property
    def error_nm(self) -> float:
        """Estimate minus truth."""
        return self.defocus_nm - self.truth_nm

    @property
    def allowed_nm(self) -> float:
        """10 nm, or 1.2 times the Cramér–Rao bound if that is larger."""
        return max(WANTED_NM, OF_BOUND * self.bound_nm)

    @property
    def kept(self) -> bool:
        """Whether the error is at most that."""
        return abs(self.error_nm) <= self.allowed_nm


def archive_spec(files: int, seed: int) -> dict:
    """Return the spec of an archive: small, then large scale, of two epochs; defocus of 100 nm RMS."""
    rng = np.random.default_rng(seed)
    images = {axis: rng.normal(0, 1, 4).round(2).tolist() for axis in ("x_mas", "y_mas")}
    images["flux"] = rng.normal(0, 0.05, 4).round(3).tolist()
    recordings = {}
    for number in range(files):
        day, scale = (NEW, OLD)[number % 4 == 3], ("Small", "Large")[2 * number >= files]
        recordings[f"file_{number:02d}"] = {
            "role": "psf",
            "mode": f"20x20_{scale}Scale_500Hz_HighGain",
            "mag_j": round(rng.uniform(8, 13 if day == NEW else 10), 1),
            "bands": "j_h",
            "frames": 48,
            "exposure_s": 0.002,
            "frame_rate_hz": 10,
            "start": f"{day}T{number % 10:02d}:{6 * (number % 9):02d}:00",
            "side_car": False,
            "sky_e_per_s": "profile",
            "sky": {"seeing_arcsec": round(rng.uniform(0.4, 1.0), 2)},
            "ncpa": {"zernike_nm": {4: round(rng.normal(0, 100), 1), 5: 25.0, 6: -30.0, 8: 20.0}},
            "detector": DETECTORS[day],
            "lenslet_images": images,
        }
    return {"simulation": "archive", "seed": seed, "motion": {"rms_mas": 7}, "recordings": recordings}


def measured_archive(
    folder: Path, files: int = 20, seed: int = 20, report: Callable[[File], None] = lambda _: None
) -> list[File]:
    """Simulate an archive in a `folder`, reduce every file with the recipe `two_by_two`, and compare.

    Files that are there already are not made again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    spec_file = folder / "archive.yaml"
    spec_file.write_text(yaml_text(archive_spec(files, seed)))
    spec = load_spec(spec_file)
    simulate(spec, folder / "simulated", jobs=1)
    found = []
    for name, keys in spec.recordings.items():
        found.append(_measured(folder, name, keys))
        report(found[-1])
    return found


def _measured(folder: Path, name: str, keys) -> File:
    """Reduce the file `name`, unless that is up to date."""
    data = folder / "simulated" / "data" / name
    recipe = load_recipe("two_by_two", (), [f"cube={data}"])
    run_recipe(recipe, folder / "reduced" / name, Selection(last="calibrate"))
    stages = json.loads((folder / "reduced" / name / "results.json").read_text())["stages"]
    (truth,) = (folder / "simulated" / "truth").glob(f"{name}__*.json")
    calibrate = stages["calibrate"]
    return File(
        name,
        keys.mode,
        str(keys.start)[:10],
        keys.mag_j,
        keys.frames,
        keys.sky.seeing_arcsec,
        _used(stages["ingest"]),
        json.loads(truth.read_text())["mean_zernike_nm"]["4"],
        calibrate["zernike_nm"]["4"],
        calibrate["sigma_nm"]["4"],
        calibrate["lenslets"]["bound_nm"]["4"],
        calibrate["lenslets"]["centroids_nm"]["4"],
        calibrate["chi2_nu"],
    )


def _used(ingest: dict) -> int:
    """Frames of the file that ingest has not rejected."""
    return sum(one["frames"] - one["frames_rejected"] for one in ingest["inputs"])


def rows(found: list[File]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield "| file | mode | day | J | seeing | frames | true | estimate | error | wanted | bound | centroids |"
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for one in found:
        _, scale, rate, _ = one.mode.split("_")
        yield (
            f"| {one.name[-2:]} | {scale} {rate} | {one.day} | {one.mag_j:.1f} | {one.seeing_arcsec:.2f} "
            f"| {one.used} | {one.truth_nm:+.1f} | {one.defocus_nm:+.1f} ± {one.sigma_nm:.1f} "
            f"| {one.error_nm:+.1f} | {one.allowed_nm:.1f} | {one.bound_nm:.1f} "
            f"| {one.centroids_nm - one.truth_nm:+.1f} |"
        )


def as_json(found: list[File]) -> list[dict]:
    """Return all numbers in JSON types."""
    return [asdict(one) for one in found]
