"""How good the 2x2 modes are: a simulated archive of raw files, and three ways to measure defocus.

The archive is reduced, and its defocus compared with the truth. The three ways (full-pupil LIFT, LIFT on four
images, and their centroids) see the same photons, reads and sky: images are those of the simulator, which
shares no optics with the model; wavefront and noise are what the estimators believe. None has an AO residual,
image motion or errors of the NCPAs. Numbers go into ``benchmarks/two_by_two.json``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from benchmarks.harness import DOCS, markdown, put
from irlos_pipe.conventions.bands import H, J
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lenslets import modes_of_centroids_nm
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.paper.common.scenes import in_four_images
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.plan import Selection
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.detector import multiplied
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.recordings.run import simulate
from irlos_pipe.simulate.recordings.spec import load_spec
from irlos_pipe.simulate.scene import Scene

RESULTS = Path(__file__).with_suffix(".json")
MAGS = (10.0, 12.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0)
OLD, NEW = "2020-02-11", "2023-07-14"
# scale and gain of the mode; e-/ADU and read noise of the day, in units of the profile
DETECTORS = {
    OLD: {"e_per_adu": 3.0, "read_noise_e": 11.0, "excess_noise_factor": 1.25},
    NEW: {"e_per_adu": 9.8 / 68, "read_noise_e": 1.0, "excess_noise_factor": 1.25},
}
REQUIRED_NM, OF_BOUND = 10.0, 1.2  # required error, or times the Cramér–Rao bound if that is larger
TTF = (2, 3, 4)
BANDS = (Band.of(J, 0.5), Band.of(H, 0.5))
EXCESS, READ_NOISE_E, READ_S = 1.25, 1.0, 0.005
TRUE_NM, DIVERSITY_NM = 60.0, {6: -170.0}
RANGE_NM = 900.0  # defocus beyond which a frame is lost, as for the loop
BELIEVED_POINTS = 3  # wavelengths per band in the model; the simulator has more


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


def measured_archive(folder: Path, files: int = 20, seed: int = 20) -> list[dict[str, Any]]:
    """Simulate an archive in a `folder`, reduce every file with the recipe `two_by_two`, and compare.

    Files that are there already are not made again. Returns what was put into every file, the frames that
    were used, and what came out [nm].
    """
    folder.mkdir(parents=True, exist_ok=True)
    spec_file = folder / "archive.yaml"
    spec_file.write_text(yaml_text(archive_spec(files, seed)))
    spec = load_spec(spec_file)
    simulate(spec, folder / "simulated", jobs=1)
    found = []
    for name, keys in spec.recordings.items():
        found.append(_measured(folder, name, keys))
        click.echo(found[-1])
    return found


def _measured(folder: Path, name: str, keys: Any) -> dict[str, Any]:
    """Reduce the file `name`, unless that is up to date."""
    data = folder / "simulated" / "data" / name
    recipe = load_recipe("two_by_two", (), [f"cube={data}"])
    run_recipe(recipe, folder / "reduced" / name, Selection(last="calibrate"))
    stages = json.loads((folder / "reduced" / name / "results.json").read_text())["stages"]
    (truth,) = (folder / "simulated" / "truth").glob(f"{name}__*.json")
    calibrate = stages["calibrate"]
    return {
        "name": name,
        "mode": keys.mode,
        "day": str(keys.start)[:10],
        "mag_j": keys.mag_j,
        "frames": keys.frames,
        "seeing_arcsec": keys.sky.seeing_arcsec,
        "used": sum(one["frames"] - one["frames_rejected"] for one in stages["ingest"]["inputs"]),
        "truth_nm": json.loads(truth.read_text())["mean_zernike_nm"]["4"],
        "defocus_nm": calibrate["zernike_nm"]["4"],
        "sigma_nm": calibrate["sigma_nm"]["4"],
        "bound_nm": calibrate["lenslets"]["bound_nm"]["4"],
        "centroids_nm": calibrate["lenslets"]["centroids_nm"]["4"],
        "chi2_nu": calibrate["chi2_nu"],
    }


def archive_table(found: Sequence[dict[str, Any]]) -> str:
    """Return the archive by scale in Markdown; required are 10 nm, or 1.2 times the bound if larger."""
    head = ("mode", "files", "as required", "error [nm RMS]", "over its σ", "largest", "centroids [nm RMS]")
    rows = []
    for scale in dict.fromkeys(one["mode"].split("_")[1] for one in found):
        own = [one for one in found if scale in one["mode"]]
        truth, fit, sigma, bound, centroids = (
            np.array([one[key] for one in own])
            for key in ("truth_nm", "defocus_nm", "sigma_nm", "bound_nm", "centroids_nm")
        )
        error = fit - truth
        kept = int((np.abs(error) <= np.maximum(REQUIRED_NM, OF_BOUND * bound)).sum())
        numbers = _rms(error), _rms(error / sigma), np.abs(error).max(), _rms(centroids - truth)
        digits = (".1f", ".2f", ".1f", ".1f")
        rows.append((scale, len(own), kept, *map(format, numbers, digits)))
    return markdown(head, rows, "lrrrrrr")


# -- three ways --------------------------------------------------------------------------------


def compared(
    mags: Sequence[float], realisations: int, exposure_s: float, seed: int
) -> list[dict[str, float]]:
    """Return RMS errors of defocus and their bounds by estimator [nm], and lost frames, by magnitude.

    Over `realisations` of the noise of exposures of `exposure_s`.
    """
    irlos = load_instrument("irlos")
    rng = np.random.default_rng(seed)
    full = Scene(
        "full", irlos.facility, BANDS, (seed,), 1, exposure_s, ncpa_nm={4: TRUE_NM}, diversity_nm=DIVERSITY_NM
    )
    four = replace(in_four_images(full), name="four")
    sides = [_Side(scene, realisations, rng) for scene in (full, four)]
    return [_point(mag_j, *sides) for mag_j in mags]


class _Side:
    """One mode of the sensor: its light, its noise, its model."""

    def __init__(self, scene: Scene, realisations: int, rng: np.random.Generator):
        self.scene, self.realisations, self.rng = scene, realisations, rng
        self.unit = expose(scene).mean_e[0].astype(float) / scene.photons
        believed = tuple(scene.spectrum(BELIEVED_POINTS))
        known = KnownWavefront(scene.diversity_nm)
        settings = PsfSettings(
            scene.geometry, scene.window, scene.pixel_scale_mas, believed, known, lenslets=scene.lenslets
        ).for_broad_images()
        self.settings = settings.for_single_frames()
        self.model = ImageModel(light_path(self.settings, TTF))
        facility = scene.facility
        photons_per_s_m0 = facility.photons_per_s_m15 * 10 ** (0.4 * 15)
        lit = [(band.centre_nm, band.share) for band in scene.bands]
        sky_per_s = facility.sky_photons_per_s(lit, photons_per_s_m0, scene.pixel_scale_mas)
        self.sky_e = sky_per_s * scene.exposure_s / scene.lenslets**2
        reads = scene.exposure_s / READ_S
        self.noise = NoiseModel(EXCESS, reads * READ_NOISE_E**2 + EXCESS * self.sky_e)

    def photons(self, mag_j: float) -> float:
        """Photons of an exposure through the whole pupil."""
        return replace(self.scene, mag_j=mag_j).photons

    def images_e(self, mag_j: float) -> np.ndarray:
        """Frames of a star, the mean sky subtracted."""
        mean = np.broadcast_to(
            self.photons(mag_j) * self.unit + self.sky_e, (self.realisations, *self.unit.shape)
        )
        signal = multiplied(self.rng.poisson(mean), EXCESS, self.rng)
        reads = self.scene.exposure_s / READ_S
        return signal - self.sky_e + np.sqrt(reads) * READ_NOISE_E * self.rng.standard_normal(mean.shape)

    def by_lift(self, images_e: np.ndarray) -> np.ndarray:
        """Defocus of every frame [nm], NaN where it is lost."""
        images = torch.as_tensor(images_e)
        good = torch.ones(images.shape[1:], dtype=torch.bool)
        if self.scene.lenslets > 1:  # four images show the sign of defocus, and any start does
            start = torch.zeros(len(images), len(TTF), dtype=torch.float64)
        else:
            start = scan_start_nm(self.model.psf, images, good)
        found = lift(self.model, images, good, self.noise, start).mode(4)[0].numpy()
        return np.where(np.abs(found) < RANGE_NM, found, np.nan)

    def bound_nm(self, mag_j: float) -> float:
        """Cramér–Rao bound of defocus."""
        wavefront = torch.tensor([[0.0, 0.0, TRUE_NM]], dtype=torch.float64)
        flux = torch.tensor([self.photons(mag_j)], dtype=torch.float64)
        return float(cramer_rao_nm(self.model, wavefront, flux, self.noise)[0, 2])


def _point(mag_j: float, full: _Side, four: _Side) -> dict[str, float]:
    images_e = four.images_e(mag_j)
    floor_e = float(np.sqrt(four.noise.floor_e2))
    scale, geometry = four.scene.pixel_scale_mas, four.scene.geometry
    by_full = full.by_lift(full.images_e(mag_j))
    centroids = modes_of_centroids_nm(images_e, geometry, scale, floor_e, TTF)[:, 2]
    return {
        "mag_j": mag_j,
        "photons": full.photons(mag_j),
        "full_nm": _rms(by_full - TRUE_NM),
        "full_bound_nm": full.bound_nm(mag_j),
        "full_lost": float(np.isnan(by_full).mean()),
        "four_nm": _rms(four.by_lift(images_e) - TRUE_NM),
        "four_bound_nm": four.bound_nm(mag_j),
        "centroids_nm": _rms(centroids - TRUE_NM),
        "centroids_bias_nm": float(np.mean(centroids) - TRUE_NM),
    }


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def comparison_table(points: Sequence[dict[str, float]]) -> str:
    """Return the comparison in Markdown."""
    columns = {
        "J": ("mag_j", ".0f"),
        "full pupil, LIFT": ("full_nm", ".1f"),
        "bound": ("full_bound_nm", ".1f"),
        "lost": ("full_lost", ".0%"),
        "four images, LIFT": ("four_nm", ".1f"),
        "bound ": ("four_bound_nm", ".1f"),
        "centroids": ("centroids_nm", ".1f"),
        "their bias": ("centroids_bias_nm", "+.1f"),
    }
    rows = [[format(one[key], digits) for key, digits in columns.values()] for one in points]
    return markdown([name.strip() for name in columns], rows)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--files", default=20, show_default=True, help="Files of the archive.")
@click.option("--realisations", default=60, show_default=True, help="Frames per magnitude.")
@click.option("--write-docs", is_flag=True, help="Put the tables into docs/two_by_two.md.")
def main(folder: Path, files: int, realisations: int, write_docs: bool) -> None:
    """Simulate and reduce an archive in FOLDER, and compare three ways to measure defocus."""
    found = measured_archive(folder, files)
    points = compared(MAGS, realisations, exposure_s=1.0, seed=22)
    RESULTS.write_text(json.dumps({"archive": found, "comparison": points}, indent=1) + "\n")
    tables = {"archive": archive_table(found), "comparison": comparison_table(points)}
    click.echo("\n".join(tables.values()))
    if write_docs:
        put(DOCS / "two_by_two.md", tables)


if __name__ == "__main__":
    main()
