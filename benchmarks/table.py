"""Results as aligned text."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.plan import CUBE

HEADER = (
    "NCPAs, 29 modes",
    "threads",
    "frames",
    "wall s",
    "CPU s",
    f"s for {CUBE}",
    "speed-up",
    "peak MiB",
    "error nm",
    "on common",
)
LIFT_HEADER = (
    "LIFT, ramp, J+H at 6 wavelengths",
    *HEADER[1:5],
    "CPU ms/frame",
    *HEADER[6:],
)
OTHER_HEADER = ("other", "threads", "frames", "wall s", "CPU s", "CPU ms/frame", "peak MiB", "error nm")


def render(results: dict) -> str:
    """Both tables, the machine above."""
    machine = results["machine"]
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, torch {machine['torch']}, "
        f"solvephase {machine['solvephase']}, {results['date']}",
        "",
    ]
    lines += _align([HEADER, *(_ncpa_row(entry) for entry in results["ncpa"])])
    more = ("NCPAs, 60 modes", *HEADER[1:])
    lines += ["", *_align([more, *(_ncpa_row(entry) for entry in results["ncpa_60"])])]
    lines += ["", *_align([LIFT_HEADER, *(_lift_row(entry) for entry in results["lift"])])]
    lines += ["", *_align([OTHER_HEADER, *(_other_row(entry) for entry in results["others"])])]
    return "\n".join([*lines, "", *_notes(results)])


def _ncpa_row(entry: dict) -> Sequence[str]:
    extrapolated = "" if entry["frames"] == CUBE else "~"
    return (
        entry["label"],
        str(entry["threads"]),
        str(entry["frames"]),
        f"{entry['wall_s']:.2f}",
        f"{entry['cpu_s']:.2f}",
        f"{extrapolated}{entry['cube_s']:.1f}",
        f"{entry['speed_up']:.1f}",
        f"{entry['peak_mib']:.0f}",
        f"{entry['error_nm']:.1f}",
        f"{entry['common_error_nm']:.1f}",
    )


def _lift_row(entry: dict) -> Sequence[str]:
    return (
        *_other_row(entry)[:6],
        f"{entry['speed_up']:.1f}",
        f"{entry['peak_mib']:.0f}",
        f"{entry['error_nm']:.1f}",
        f"{entry['common_error_nm']:.1f}",
    )


def _other_row(entry: dict) -> Sequence[str]:
    error = f"{entry['error_nm']:.1f}" if "error_nm" in entry else ""
    return (
        entry["label"],
        str(entry["threads"]),
        str(entry["frames"]),
        f"{entry['wall_s']:.2f}",
        f"{entry['cpu_s']:.2f}",
        f"{1e3 * entry['cpu_s'] / entry['frames']:.2f}",
        f"{entry['peak_mib']:.0f}",
        error,
    )


def _notes(results: dict) -> list[str]:
    latency = next(entry for entry in results["others"] if "median_ms" in entry)
    common = results["common_frames"]
    return [
        f"~ extrapolated linearly to {CUBE} frames from those that were fitted.",
        "speed-up: processor time per frame of the first line over that of the line.",
        f"CUDA: {results['cuda']}, by wall clock." if results["cuda"] else "CUDA: no device here, no line.",
        "error: total RMS of Noll 2-30 of the mean estimate against the truth, over all frames of the line",
        f"and over the first {common}, which all lines have fitted; LIFT: RMS of the defocus over all",
        "images of the line and over those that all lines have fitted.",
        f"single-frame LIFT: median {latency['median_ms']:.1f} ms, "
        f"99th percentile {latency['p99_ms']:.1f} ms.",
    ]


def _align(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]
