"""What a run shows: bad exposures that were commanded, and right ones that were refused."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from benchmarks.focus_faults.cases import FOCUS, Case
from benchmarks.focus_faults.rig import Outcome, Rig, is_wrong, run
from benchmarks.focus_faults.sky import Skies
from irlos_pipe.focus.calibration import Calibration

OPEN = "the loop is not closed"


@dataclass(frozen=True)
class Verdict:
    """Of one case.

    Attributes
    ----------
    bad, right : int
        Exposures.
    commanded_right, commanded_wrongly : int
        Bad ones that were commanded although, with a value within its error or not.
    refused : int
        Right ones that were not used, beyond those that a case may lose.
    wrong_right : int
        Right ones whose value was commanded and is beyond its error.
    reasons : list of str
        Why bad ones were not used.
    problem : str
        What else was not as asked; empty if nothing.
    walked_nm : float
        Of the offset from the truth where the loop is to be stopped.
    """

    case: str
    kind: str
    family: str
    known: bool
    bad: int = 0
    right: int = 0
    commanded_right: int = 0
    commanded_wrongly: int = 0
    refused: int = 0
    wrong_right: int = 0
    reasons: list[str] = field(default_factory=list)
    problem: str = ""
    walked_nm: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether anything is not as asked."""
        return bool(self.commanded_wrongly or self.refused or self.problem)


def judge(case: Case, skies: Skies, calibration: Calibration, output: Path) -> Verdict:
    """Run a case and judge it."""
    outcome = run(case.rig(skies), calibration, output)
    counts = judged(outcome)
    stopped = any(OPEN in event for event in outcome.events)
    problem = ""
    if case.told and not any(case.told in event for event in outcome.events):
        problem = f"no event says '{case.told}'"
    if stopped and case.told != OPEN:
        problem = "a closed loop was stopped"
    if case.kind == FOCUS and stopped:
        counts |= {"refused": 0}
    walked = float(outcome.records[-1]["offset_nm"]) if case.kind == FOCUS and outcome.records else 0.0
    counts["refused"] = max(0, counts["refused"] - case.lost)
    return Verdict(case.name, case.kind, case.family, case.known, **counts, problem=problem, walked_nm=walked)


def judged(outcome: Outcome) -> dict[str, Any]:
    """Return the counts of a run."""
    records = {one["counter"]: one for one in outcome.records}
    bad = [(records.get(shot.counter), shot) for shot in outcome.shots if not shot.right]
    right = [(records.get(shot.counter), shot) for shot in outcome.shots if shot.right]
    used = [(record, shot) for record, shot in bad if record is not None and record["valid"]]
    wrong = sum(is_wrong(record, shot) for record, shot in used)
    reasons = sorted({reason for record, _ in bad if record is not None for reason in record["reasons"]})
    return {
        "bad": len(bad),
        "right": len(right),
        "commanded_right": len(used) - wrong,
        "commanded_wrongly": wrong,
        "refused": sum(record is None or not record["valid"] for record, _ in right),
        "wrong_right": sum(
            is_wrong(record, shot) for record, shot in right if record is not None and record["valid"]
        ),
        "reasons": reasons,
    }


@dataclass(frozen=True)
class Hour:
    """Of an hour of right exposures: those refused and why, and those beyond their error."""

    name: str
    seeing: float
    mag_j: float
    exposures: int
    refused: int
    wrong: int
    reasons: list[str]
    residual_nm: float
    sigma_nm: float


def judge_hour(
    name: str,
    seeing: float,
    mag_j: float,
    changes: dict[str, Any],
    skies: Skies,
    calibration: Calibration,
    output: Path,
) -> Hour:
    """Run an hour and judge it."""
    rig = Rig(skies, mag_j, crc32(f"{skies.seed}.{name}".encode()), **changes)
    outcome = run(rig, calibration, output)
    counts = judged(outcome)
    reasons = {reason for one in outcome.records for reason in one["reasons"]}
    reasons |= {event for event in outcome.events if OPEN in event}
    truth = np.array([shot.defocus_nm for shot in outcome.shots[60:]])
    sigma_nm = float(np.median([one["sigma_nm"] for one in outcome.records if one["valid"]]))
    numbers = len(outcome.shots), counts["refused"], counts["wrong_right"]
    return Hour(name, seeing, mag_j, *numbers, sorted(reasons), float(np.sqrt(np.mean(truth**2))), sigma_nm)
