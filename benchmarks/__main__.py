"""Run the benchmarks: a table on stdout, everything in ``benchmarks/results.json``."""

from __future__ import annotations

import json
import os
import platform
import tempfile
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.breakdown import measure_breakdown
from benchmarks.docs import breakdown
from benchmarks.docs import write_docs as put_into_docs
from benchmarks.inputs import Inputs, prepare
from benchmarks.measure import in_own_process
from benchmarks.plan import CUBE, LIFT, NCPA, NCPA_60, OTHERS, Entry
from benchmarks.table import render

RESULTS = Path(__file__).parent / "results.json"


@click.command()
@click.option("--quick", is_flag=True, help="Few frames, half a minute; results.json is left alone.")
@click.option("--write-docs", is_flag=True, help="Put the results into docs/performance.md.")
def main(quick: bool, write_docs: bool) -> None:
    """Time irlos_pipe beside other implementations, on the same frames in the same run."""
    with tempfile.TemporaryDirectory() as folder:
        results = measure_all(Path(folder), quick)
    if not quick:
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    click.echo(f"{render(results)}\n\n{breakdown(results)}")
    if write_docs:
        put_into_docs(results)


def measure_all(folder: Path, quick: bool) -> dict:
    """Prepare the inputs in `folder` and run every case."""
    drawn = max(entry.quick_frames if quick else entry.frames for entry in NCPA)
    prepare(folder, drawn, lambda frames: tqdm(frames, desc="drawing frames", disable=None))
    cuda = torch.cuda.is_available()
    groups = [[one for one in group if cuda or not one.gpu] for group in (NCPA, NCPA_60, LIFT, OTHERS)]
    bar = tqdm(total=sum(map(len, groups)) + 1, disable=None)
    ncpa, more, ramp, others = ([_measure(entry, folder, quick, bar) for entry in group] for group in groups)
    common = _compare(ncpa, Inputs(folder))
    _compare(more, Inputs(folder))
    _compare_ramp(ramp)
    bar.set_description("breakdown")
    shares = measure_breakdown(Inputs(folder), frames=8 if quick else 48)
    bar.close()
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "machine": _machine(),
        "common_frames": common,
        "cuda": torch.cuda.get_device_name() if cuda else None,
        "ncpa": ncpa,
        "ncpa_60": more,
        "lift": ramp,
        "others": others,
        "breakdown": shares,
    }


def _measure(entry: Entry, folder: Path, quick: bool, bar: tqdm) -> dict:
    bar.set_description(entry.label)
    outcome = in_own_process(entry.case, folder, entry.quick_frames if quick else entry.frames, entry.threads)
    bar.update()
    return {"label": entry.label} | outcome


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
    return {
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("torch", "numpy", "solvephase")},
    }


def _cpu_name() -> str:
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
