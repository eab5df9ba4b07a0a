"""Which estimates of a capture experiment are right, which are wrong, and which say that they failed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Right estimates err by less than 20 nm (AO residual, calibration, noise), wrong ones by hundreds: the next
# minimum of χ² lies near the opposite defocus. Any limit between counts alike; both sides are reported.
WRONG_NM = 50.0


@dataclass(frozen=True)
class Estimates:
    """Estimates from one start.

    Attributes
    ----------
    true_nm, defocus_nm : ndarray, (cases,)
    converged : ndarray of bool, (cases,)
        What the estimator says of itself.
    """

    true_nm: np.ndarray
    defocus_nm: np.ndarray
    converged: np.ndarray

    @property
    def error_nm(self) -> np.ndarray:
        """Size of the error, (cases,)."""
        return np.abs(self.defocus_nm - self.true_nm)

    @property
    def captured(self) -> np.ndarray:
        """Right and said to be, (cases,)."""
        return self.converged & (self.error_nm <= WRONG_NM)

    @property
    def wrong(self) -> np.ndarray:
        """Wrong and said to be right, (cases,)."""
        return self.converged & ~self.captured

    def within(self, reach_nm: float) -> Estimates:
        """The cases whose true defocus is no larger."""
        inside = np.abs(self.true_nm) <= reach_nm
        return Estimates(self.true_nm[inside], self.defocus_nm[inside], self.converged[inside])

    def range_nm(self) -> float:
        """Defocus up to which every case was captured: the smallest that was not, or the largest tried."""
        size = np.abs(self.true_nm)
        return float(size[~self.captured].min(initial=size.max(initial=0.0)))

    def counts(self) -> dict[str, int]:
        """Cases, and how many were captured, wrong, or flagged as failed."""
        return {
            "cases": len(self.true_nm),
            "captured": int(self.captured.sum()),
            "wrong": int(self.wrong.sum()),
            "flagged": int((~self.converged).sum()),
        }

    def gap_nm(self) -> tuple[float, float]:
        """Largest error of the captured and smallest of the wrong ones; NaN where there are none."""
        right, wrong = self.error_nm[self.captured], self.error_nm[self.wrong]
        return (
            float(right.max()) if len(right) else float("nan"),
            float(wrong.min()) if len(wrong) else float("nan"),
        )

    def rms_nm(self) -> float:
        """RMS error of the captured cases; NaN without any."""
        right = self.error_nm[self.captured]
        return float(np.sqrt(np.mean(right**2))) if len(right) else float("nan")


def success_per_bin(estimates: Estimates, edges_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Captured and all cases between consecutive edges of true defocus, (bins,) each."""
    cases, _ = np.histogram(estimates.true_nm, edges_nm)
    captured, _ = np.histogram(estimates.true_nm[estimates.captured], edges_nm)
    return captured, cases
