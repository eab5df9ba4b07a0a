"""What the results of the experiment `faint` have to keep."""

from __future__ import annotations

import math
from collections.abc import Iterator

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.paper.faint.results import ExposureGroup, FaintResults, VariantCurve
from irlos_pipe.product.product import Check

OVER_THEORY = 1.5
DEFAULT_WAY = "default_3"


def checks_of(results: FaintResults) -> list[Check]:
    """Return the checks of the `results`: no limit without NCPAs, three modes not before nine, theory met."""
    return [check for group in results.exposures for check in _of_group(group)]


def _of_group(group: ExposureGroup) -> Iterator[Check]:
    yield _uncalibrated(group)
    calibrated = {curve.key: curve for curve in group.curves if curve.calibrated}
    for key, curve in calibrated.items():
        three = calibrated.get(f"{curve.kind}_3")
        if key.endswith("_9") and three is not None:
            yield _fewer_modes(group, three, curve)
    if DEFAULT_WAY in calibrated:
        yield _bright(group, calibrated[DEFAULT_WAY])


def _uncalibrated(group: ExposureGroup) -> Check:
    reached = sum(not curve.calibrated and math.isfinite(curve.limit_mag) for curve in group.curves)
    return Check(
        f"ways without NCPAs that meet the criterion, {group.exposure_s:g} s",
        reached,
        "",
        None,
        0,
        f"{reached} of the uncalibrated ways",
    )


def _fewer_modes(group: ExposureGroup, three: VariantCurve, nine: VariantCurve) -> Check:
    """The paper's Sect. 6.3."""
    return Check(
        f"magnitudes that three modes reach further than nine, {three.kind}, {group.exposure_s:g} s",
        three.limit_mag - nine.limit_mag,
        "mag",
        0.0,
        None,
        f"m_J {three.limit_mag:.1f} and {nine.limit_mag:.1f}",
    )


def _bright(group: ExposureGroup, curve: VariantCurve) -> Check:
    """The brightest star: the AO residual's own defocus, and the Cramér–Rao bound."""
    theory_nm = math.hypot(group.residual_floor_nm, MEDIAN_OF_NORMAL * curve.crb_nm[0])
    error_nm = curve.median_abs_error_nm[0]
    return Check(
        f"error of the brightest star over theory, default, {group.exposure_s:g} s",
        error_nm / theory_nm,
        "",
        None,
        OVER_THEORY,
        f"median {error_nm:.1f} nm, theory {theory_nm:.1f} nm",
    )
