"""What the light of a ramp adds to the calibrated wavefront: by its wavelengths, and by its filter or lens.

NCPAs are calibrated in a narrow band, often with another diversity, and used in a broad one. Where the frames
of such a ramp misfit, a wavefront of their own is fitted to all of them together and kept if it explains the
misfit: what depends on wavelength (`chromatic_ncpa`) and what the ramp's filter or lens has (`filter_ncpa`).
Other things that a model may lack change with the focus in another way, and are hardly imitated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.effects import Effect
from irlos_pipe.effects.chromatic import BROAD_NM, ChromaticNcpa, FilterNcpa
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.estimate.lift_errors import FrameErrors
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.frames.recording import Acquisition
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.ingest.results import IngestResults
from irlos_pipe.stages.lift.config import Config

OWN = (ChromaticNcpa, FilterNcpa)
ALIKE = 0.01  # mean wavelengths that differ by less are of one filter
EXCUSED = 3.0  # standard errors up to which a wavefront of filter or lens may be one of the calibration
EXPLAINED = 0.5  # of the excess of χ²/ν over its nominal value: less, and the model lacks something else


def has_other_light(ctx: StageContext[Config], acquisition: Acquisition) -> bool:
    """Return whether the light of a ramp passes another filter or lens than that of its calibration.

    Parameters
    ----------
    ctx : StageContext
    acquisition : Acquisition
        How the ramp was taken.
    """
    config = ctx.config
    if not config.calibrated or "calibrate" not in ctx.products or config.common_modes or config.singly:
        return False
    calibrated_nm = results_of(CalibrateResults, ctx.products["calibrate"]).wavelength_nm
    own_nm, source = acquisition.wavelength_nm, acquisition.diversity_source
    cubes = ctx.products["calibrate"].config.get("input")
    seen = [
        one.observed.diversity_source
        for one in results_of(IngestResults, ctx.products["ingest"]).inputs
        if one.input == cubes
    ]
    return abs(own_nm / calibrated_nm - 1) > ALIKE or any(one != source for one in seen)


def with_own_wavefront(effects: Sequence[Effect], conditions: Conditions) -> list[Effect]:
    """Return the `effects` with those that make the wavefront of the ramp's own light, where they lack them.

    Parameters
    ----------
    effects : sequence of Effect
    conditions : Conditions
        Of the ramp.
    """
    listed = {effect.name for effect in effects}
    broad = conditions.settings.span_nm > BROAD_NM
    own = [kind.under(conditions) for kind in OWN if broad or kind is not ChromaticNcpa]
    return [*effects, *(effect for effect in own if effect.name not in listed)]


def explains(before: FrameErrors, after: FrameErrors) -> bool:
    """Return whether a fit of a ramp explains what another one before it misses.

    Parameters
    ----------
    before, after : FrameErrors
    """
    return after.excess <= EXPLAINED * before.excess


def older_text(fit: RampFit, calibration_nm: float) -> str:
    """Return what a wavefront of filter or lens says that is larger than errors excuse; else nothing.

    Parameters
    ----------
    fit : RampFit
    calibration_nm : float
        Error of the calibrated wavefront [nm RMS].
    """
    if FilterNcpa.name not in fit.effects:
        return ""
    size_nm = _size(fit.effects[FilterNcpa.name][FilterNcpa.table])
    error_nm = float(np.hypot(fit.errors.get(FilterNcpa.name, 0.0), calibration_nm))
    if size_nm < EXCUSED * error_nm:
        return ""
    return (
        f"the ramp's own light adds {size_nm:.0f} ± {error_nm:.0f} nm RMS to the calibrated wavefront: the "
        "calibration is not of this time, unless filter or lens differ by so much"
    )


def _size(table: Any) -> float:
    return float(np.linalg.norm(list(table.values())))


def own_text(effects: Mapping[str, Mapping[str, Any]]) -> str:
    """Return in words how large a wavefront of the ramp's own light is; empty without one.

    Parameters
    ----------
    effects : mapping
        Public parameters of the effects, by name.
    """
    sizes = {kind.name: _size(effects[kind.name][kind.table]) for kind in OWN if kind.name in effects}
    units = {ChromaticNcpa.name: "nm RMS per µm of wavelength", FilterNcpa.name: "nm RMS of filter or lens"}
    texts = [f"{size:.0f} {units[name]}" for name, size in sizes.items()]
    return f"its own light adds {' and '.join(texts)}" if texts else ""
