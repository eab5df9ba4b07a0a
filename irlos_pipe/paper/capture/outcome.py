"""Which estimates of a capture experiment are right, which are wrong, and which are flagged as failed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.paper.capture.results import Counts

# Right estimates err by less than 20 nm (AO residual, calibration, noise), wrong ones by hundreds: the next
# minimum of χ² lies near the opposite defocus. Any limit between gives the same counts; both are reported.
WRONG_NM = 50.0


@dataclass(frozen=True)
class Estimates:
    """Estimates from one start.

    Attributes
    ----------
    true_nm, defocus_nm : ndarray, (cases,)
    converged : ndarray of bool, (cases,)
        As the estimator reports it.
    """

    true_nm: np.ndarray
    defocus_nm: np.ndarray
    converged: np.ndarray

    @property
    def error_nm(self) -> np.ndarray:
        """Return the size of the error, (cases,)."""
        return np.abs(self.defocus_nm - self.true_nm)

    @property
    def captured(self) -> np.ndarray:
        """Return which cases are right and reported as right, (cases,)."""
        return self.converged & (self.error_nm <= WRONG_NM)

    @property
    def wrong(self) -> np.ndarray:
        """Return which cases are wrong and reported as right, (cases,)."""
        return self.converged & ~self.captured

    def within(self, reach_nm: float) -> Estimates:
        """Return the cases whose true defocus is no larger than `reach_nm`."""
        inside = np.abs(self.true_nm) <= reach_nm
        return Estimates(self.true_nm[inside], self.defocus_nm[inside], self.converged[inside])

    def range_nm(self) -> float:
        """Return the smallest defocus that was not captured, or the largest tried."""
        size = np.abs(self.true_nm)
        return float(size[~self.captured].min(initial=size.max(initial=0.0)))

    def counts(self) -> Counts:
        """Count the cases, and those captured, wrong, or flagged as failed."""
        return Counts(
            cases=len(self.true_nm),
            captured=int(self.captured.sum()),
            wrong=int(self.wrong.sum()),
            flagged=int((~self.converged).sum()),
        )

    def gap_nm(self) -> tuple[float, float]:
        """Return the largest error of the captured and the smallest of the wrong cases; NaN without any."""
        right, wrong = self.error_nm[self.captured], self.error_nm[self.wrong]
        return (
            float(right.max()) if len(right) else float("nan"),
            float(wrong.min()) if len(wrong) else float("nan"),
        )

    def rms_nm(self) -> float:
        """Return the RMS error of the captured cases; NaN without any."""
        right = self.error_nm[self.captured]
        return float(np.sqrt(np.mean(right**2))) if len(right) else float("nan")


def success_per_bin(estimates: Estimates, edges_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return captured and all cases of `estimates` between consecutive edges of true defocus, (bins,) each.

    `edges_nm`, (bins + 1,), rises.
    """
    cases, _ = np.histogram(estimates.true_nm, edges_nm)
    captured, _ = np.histogram(estimates.true_nm[estimates.captured], edges_nm)
    return captured, cases
