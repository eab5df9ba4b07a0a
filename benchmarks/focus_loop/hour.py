"""An accelerated hour of the loop with everything that can happen to it, next to truth and theory."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from benchmarks.focus_loop.ageing import Ageing
from benchmarks.focus_loop.run import Outcome, Trial
from benchmarks.focus_loop.telescope import Night, scene_of

HOUR = 3600
SETTLED = 60  # exposures after the start, and after a fault, that do not count as undisturbed
SPAN = 600  # exposures over which the residual is averaged, to see it change
# First and last exposure of what goes wrong with the light and the frames.
FAULTS = {
    "burst": [(400, 430)],
    "lost": [(600, 620)],
    "late": [(800, 805)],
    "doubled": [(850, 855)],
    "swapped": [(900, 905)],
    "damaged": [(950, 955)],
    "missing": [(1000, 1003)],
    "nan": [(1050, 1052)],
    "clock": [(2100, 2110)],
}
KILL_LOOP, KILL_TELESCOPE, FULL, FREE, EXCHANGE = 1200, 1500, 1800, 1860, 2400


# All that happens, with the first and last exposure of each.
EVENTS = {name: spans[0] for name, spans in FAULTS.items()} | {
    "kill -9 of the loop": (KILL_LOOP, KILL_LOOP),
    "kill -9 of the telescope": (KILL_TELESCOPE, KILL_TELESCOPE),
    "full disk": (FULL, FREE),
    "calibration replaced": (EXCHANGE, EXCHANGE),
}


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path, exists=True))
@click.argument("other", type=click.Path(path_type=Path, exists=True))
@click.option("--output", type=click.Path(path_type=Path), required=True, help="A new folder.")
@click.option("--mag-j", type=float, default=12.0, show_default=True)
@click.option("--reads", type=int, default=4, show_default=True, help="Of an exposure of a second.")
@click.option("--start-nm", type=float, default=850.0, show_default=True, help="Defocus at the beginning.")
@click.option("--exposures", type=int, default=HOUR, show_default=True, help="Fewer leave later faults out.")
@click.option(
    "--turn-deg", type=float, default=0.0, help="By which half of the NCPAs have turned at the end."
)
@click.option("--drift-nm", type=float, default=0.0, help="RMS by which the NCPAs have drifted at the end.")
def main(
    calibration: Path,
    other: Path,
    output: Path,
    mag_j: float,
    reads: int,
    start_nm: float,
    exposures: int,
    turn_deg: float,
    drift_nm: float,
) -> None:
    """Run the hour with the run folder CALIBRATION, which is replaced by OTHER after forty minutes."""
    ageing = Ageing(turn_deg, drift_nm=drift_nm)
    night = Night(
        mag_j=mag_j, reads=reads, exposures=exposures, start_nm=start_nm, faults=FAULTS, ageing=ageing
    )
    trial = Trial(output, calibration, night, actions_of(other))
    trial.run()
    summary = summary_of(trial.outcome())
    (output / "summary.json").write_text(json.dumps(summary, indent=1))
    click.echo(json.dumps(summary, indent=1))


def actions_of(other: Path) -> dict:
    """What happens to processes, disk and calibration."""
    return {
        KILL_LOOP: Trial.kill_loop,
        KILL_TELESCOPE: Trial.kill_telescope,
        FULL: Trial.fill_disk,
        FREE: Trial.free_disk,
        EXCHANGE: lambda trial: trial.replace_calibration(other),
    }


def summary_of(outcome: Outcome) -> dict:
    """Numbers of docs/focus.md."""
    exposures = outcome.night.exposures
    valid = [one for one in outcome.records if one["valid"]]
    latency = [one["latency_ms"] for one in outcome.records if "late" not in one["reasons"]]
    memory = outcome.memory_mib
    quarter = max(1, len(memory) // 4)
    return {
        "mag_j": outcome.night.mag_j,
        "exposures": exposures,
        "records": len(outcome.records),
        "closed_after": outcome.closed_at,
        "residual_nm": outcome.residual_nm(_undisturbed(outcome)),
        "course": _course(outcome),
        "predicted_nm": outcome.predicted_nm(),
        "sigma_nm": float(np.median([one["sigma_photon_nm"] for one in valid])),
        "valid": len(valid) / len(outcome.records),
        "latency_ms": np.percentile(latency, [50, 99]).tolist(),
        "wrongly_commanded": outcome.wrongly_commanded(),
        "exposures_without_record": sorted(outcome.lost()),
        "sequence_is_whole": outcome.sequence_is_whole(),
        "memory_mib": [float(np.median(part)) for part in (memory[:quarter], memory[-quarter:])],
        "recovery": {
            name: _recovery(outcome, *span) for name, span in EVENTS.items() if span[1] < exposures - SETTLED
        },
        "events": outcome.events,
    }


def _undisturbed(outcome: Outcome) -> list[int]:
    """All exposures but those of the start, of faults and shortly after."""
    quiet = set(range(outcome.closed_at + SETTLED, outcome.night.exposures))
    for first, last in EVENTS.values():
        quiet -= set(range(first, last + SETTLED))
    return sorted(quiet)


def _course(outcome: Outcome) -> list[dict]:
    """Mean and RMS residual of undisturbed exposures, and the change of the NCPAs, by ten minutes."""
    night, quiet = outcome.night, _undisturbed(outcome)
    scene = scene_of(night)
    rows = []
    for first in range(0, night.exposures, SPAN):
        inside = [i for i in quiet if first <= i < first + SPAN]
        if not inside:
            continue
        changed_nm = night.ageing.change_nm(scene, (first + SPAN / 2) / HOUR, night.seed)
        rows.append(
            {
                "first_min": first / 60,
                "ncpa_changed_nm": float(np.linalg.norm(list(changed_nm.values()))),
                "mean_nm": float(np.mean([outcome.truth[i]["residual_nm"] for i in inside])),
                "rms_nm": outcome.residual_nm(inside),
            }
        )
    return rows


def _recovery(outcome: Outcome, first: int, last: int) -> dict:
    during = [abs(outcome.truth[i]["residual_nm"]) for i in range(first, last + 10)]
    return {"largest_nm": max(during), "exposures": outcome.recovery(last)}


if __name__ == "__main__":
    main()
