"""Run the benchmarks: a table on stdout, everything in ``benchmarks/results.json``."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.breakdown import measure_breakdown
from benchmarks.harness import DOCS, REPOSITORY, markdown, put
from benchmarks.inputs import Inputs, prepare

RESULTS = Path(__file__).parent / "results.json"
CUBE = 300  # frames of the calibration that all NCPA cases are scaled to
MANY = 3000  # enough for many processors, or a GPU, to have work
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "AOCORE_FFT_WORKERS",
    "AOCORE_BLAS_THREADS",
)


@dataclass(frozen=True)
class Entry:
    """One line of the table."""

    case: str  # name in `cases.CASES`
    label: str
    # frames, quick_frames: frames that are really worked on, by default and with ``--quick``.
    frames: int
    quick_frames: int
    threads: int = 1  # workers of irlos_pipe
    gpu: bool = False  # run only where PyTorch finds a CUDA device


WORKERS = [count for count in (1, 2, 4, 8, 16) if count <= (os.cpu_count() or 1)]
SCAN = "irlos sensitivity scan, 3 and 9 modes, halo"
GROUPS: dict[str, tuple[Entry, ...]] = {
    "ncpa": (
        Entry("fft_lbfgs", "padded FFT, autograd, L-BFGS, L1", 12, 3),
        Entry("solvephase_lm", "solvephase, LM per frame, weighted", 60, 3),
        *(Entry("dip_global", "irlos dip_global, L1", CUBE, 30, threads=count) for count in WORKERS),
        Entry("lift_slices", "irlos lift_slices, weighted", CUBE, 30),
        Entry("dip_global", "irlos dip_global, L1", MANY, 30, threads=WORKERS[-1]),
        Entry("dip_global_cuda", "irlos dip_global, L1, CUDA", MANY, 30, gpu=True),
    ),
    "ncpa_60": (
        Entry("fft_lbfgs_60", "padded FFT, autograd, L-BFGS, L1", 12, 3),
        Entry("dip_global_60", "irlos dip_global, L1", CUBE, 30),
        Entry("dip_global_60_cuda", "irlos dip_global, L1, CUDA", MANY, 30, gpu=True),
    ),
    "lift": (
        Entry("lift_numpy", "NumPy FFT, Gauss-Newton per frame", 7, 2),
        Entry("lift_solvephase", "solvephase, per frame", 7, 3),
        Entry("lift_bare", "irlos lift, the ramp once", 42, 42),
        Entry("lift_bare", "irlos lift, ten realisations", 420, 84),
        Entry("lift_halo", "irlos lift, ten realisations, halo", 420, 84),
        Entry("lift_halo_cuda", "irlos lift, many realisations, halo, CUDA", 10_000, 84, gpu=True),
    ),
    "others": (
        Entry("long_exposure", "irlos long_exposure, calibration-sky, 230 modes", 200, 200),
        Entry("long_exposure_cuda", "irlos long_exposure, the same, CUDA", 200, 200, gpu=True),
        Entry("lift_latency", "irlos lift, single frames, 2 wavelengths", 50, 20),
        *(Entry("sensitivity_scan", SCAN, 924, 88, threads=count) for count in WORKERS),
        Entry("sensitivity_scan_cuda", f"{SCAN}, CUDA", 9240, 88, gpu=True),
        Entry("model_images", "irlos model, images, 1 wavelength", 480, 64),
        Entry("model_jacobian", "irlos model, images and 29 derivatives", 160, 32),
        Entry("stream_10000", "irlos run, ingest to long_exposure, one cube", 10_000, 600),
    ),
}


@click.command()
@click.option("--quick", is_flag=True, help="Few frames, half a minute; results.json is left alone.")
@click.option("--write-docs", is_flag=True, help="Put the results into docs/performance.md.")
def main(quick: bool, write_docs: bool) -> None:
    """Time irlos_pipe next to other implementations, on the same frames in the same run."""
    with tempfile.TemporaryDirectory() as folder:
        results = measure_all(Path(folder), quick)
    if not quick:
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    click.echo(f"{render(results)}\n\n{breakdown(results)}")
    if write_docs:
        put(DOCS / "performance.md", {"table": render(results)})


def measure_all(folder: Path, quick: bool) -> dict:
    """Prepare the inputs in `folder` and run every case."""
    prepare(folder, 30 if quick else CUBE, lambda frames: tqdm(frames, desc="drawing frames", disable=None))
    cuda = torch.cuda.is_available()
    groups = {key: [one for one in group if cuda or not one.gpu] for key, group in GROUPS.items()}
    bar = tqdm(total=sum(map(len, groups.values())) + 1, disable=None)
    found = {key: [_measure(one, folder, quick, bar) for one in group] for key, group in groups.items()}
    common = _compare(found["ncpa"], Inputs(folder))
    _compare(found["ncpa_60"], Inputs(folder))
    _compare_ramp(found["lift"])
    bar.set_description("breakdown")
    shares = measure_breakdown(Inputs(folder), frames=8 if quick else 48)
    bar.close()
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "machine": _machine(),
        "common_frames": common,
        "cuda": torch.cuda.get_device_name() if cuda else None,
        **found,
        "breakdown": shares,
    }


def _measure(entry: Entry, folder: Path, quick: bool, bar: tqdm) -> dict:
    """Run one case in a fresh interpreter, whose libraries get one thread each."""
    bar.set_description(entry.label)
    frames, threads = str(entry.quick_frames if quick else entry.frames), str(entry.threads)
    command = [sys.executable, "-m", "benchmarks.cases", entry.case, str(folder), frames, threads]
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=REPOSITORY)
    if done.returncode != 0:
        why = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise SystemExit(f"benchmark {entry.case} failed: {why}")
    bar.update()
    outcome = json.loads(done.stdout.splitlines()[-1])
    return {"label": entry.label} | outcome | {"case": entry.case, "threads": entry.threads}


def _compare(entries: list[dict], inputs: Inputs) -> int:
    """Add errors, the extrapolated time and the speed-up to every entry; returns the frames all share."""
    common = min(entry["frames"] for entry in entries)
    for entry in entries:
        estimates_nm = np.array(entry.pop("estimates_nm"))
        entry["error_nm"] = inputs.frames.error_nm(estimates_nm)
        entry["common_error_nm"] = inputs.frames.error_nm(estimates_nm[:common])
        entry["cube_s"] = _per_frame(entry, _clock(entry)) * CUBE
        entry["speed_up"] = _speed_up(entries[0], entry)
    return common


def _compare_ramp(entries: list[dict]) -> None:
    """The same for fits of a ramp, whose errors are those of single images."""
    errors_nm = [entry.pop("errors_nm") for entry in entries]
    shared = set.intersection(*map(set, errors_nm))
    for entry, of_images in zip(entries, errors_nm, strict=True):
        entry["error_nm"] = _rms(of_images.values())
        entry["common_error_nm"] = _rms(of_images[image] for image in shared)
        entry["speed_up"] = _speed_up(entries[0], entry)


def _speed_up(baseline: dict, entry: dict) -> float:
    return _per_frame(baseline, _clock(entry)) / _per_frame(entry, _clock(entry))


def _clock(entry: dict) -> str:
    """The clock that counts for a case."""
    return entry.get("clock", "cpu_s")


def _per_frame(entry: dict, clock: str) -> float:
    return entry[clock] / entry["frames"]


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _machine() -> dict:
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("torch", "numpy", "solvephase")},
    }


# -- results as tables -------------------------------------------------------------------------

COLUMNS: dict[str, Callable[[dict], str]] = {
    "threads": lambda entry: str(entry["threads"]),
    "frames": lambda entry: str(entry["frames"]),
    "CPU ms/frame": lambda entry: f"{1e3 * entry['cpu_s'] / entry['frames']:.2f}",
    "speed-up": lambda entry: f"{entry['speed_up']:.1f}" if "speed_up" in entry else "",
    "error nm": lambda entry: f"{entry['error_nm']:.1f}" if "error_nm" in entry else "",
}
TITLES = {"ncpa": "29 modes: ", "ncpa_60": "60 modes: ", "lift": "ramp: ", "others": ""}


def render(results: dict) -> str:
    """Markdown table of all cases, the machine below."""
    rows = [
        [title + entry["label"], *(text(entry) for text in COLUMNS.values())]
        for group, title in TITLES.items()
        for entry in results[group]
    ]
    machine = results["machine"]
    return (
        f"{markdown(['', *COLUMNS], rows, 'l' + 'r' * len(COLUMNS))}\n\n"
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, torch {machine['torch']}, "
        f"solvephase {machine['solvephase']}, {results['cuda'] or 'no CUDA device'}, {results['date']}."
    )


def breakdown(results: dict) -> str:
    """Markdown table of shares, and the floors."""
    measured = results["breakdown"]
    both = dip, lift = measured["dip_global"], measured["lift"]
    groups = sorted(dip["shares"] | lift["shares"], key=lambda group: -dip["shares"].get(group, 0.0))
    rows: list[list[Any]] = [
        [group, *(f"{one['shares'].get(group, 0.0):.0%}" for one in both)] for group in groups
    ]
    floor = f"floor: the single-precision products at {measured['gflops']:.0f} GFlop/s"
    rows.append([floor, *(f"{one['floor_s'] / one['seconds']:.0%}" for one in both)])
    rows.append(["distance to the floor", *(f"{one['over_floor']:.1f}×" for one in both)])
    return markdown(["one thread", "dip_global", "lift, ramp"], rows)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
