"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

import json
from collections.abc import Sequence
from math import nan
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.diagnosis import records
from irlos_pipe.diagnosis.records import DRIFT_NM
from irlos_pipe.files.regular import read_regular
from irlos_pipe.optics.image_quality import CURVES
from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.product.results import DITTO, ByNoll, EffectValues, Number, ResultsPart, StageResults, item
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.stages.base import StageConfig, late

VERSION = 39
NEEDS = ("ingest",)
READS = ("calibrate", "lift")
Noll = Annotated[int, Field(ge=2, le=HIGHEST_NOLL)]
Nanometres = Annotated[float, Field(ge=-5000, le=5000)]
ARRAYS = {
    "measured_e": ("e- ±", "y, x", "mean of the held-out frames"),
    "before_e": ("e-", "y, x", "predicted by the model as it was"),
    "after_e": ("e-", "y, x", "predicted by the model with what was found"),
    "leading_mode": ("sigma", "y, x", "leading mode of the residual over the frames"),
    "added_opd_nm": ("nm", "y, x of the pupil", "wavefront that was added"),
    "added_amplitude": ("", "y, x of the pupil", "amplitude that was added"),
    "noll": ("", "mode", "Noll index of every mode in the model"),
    "zernike_before_nm": ("nm", "mode", "total static wavefront, model as it was"),
    "zernike_after_nm": ("nm ±", "mode", "total static wavefront, with what was found"),
    **CURVES,
    "left_frequency": ("D/λ", "frequency", "spatial frequency of the residual"),
    "left_power_<model>": ("", "frequency", "power of the residual over its standard error"),
    "commanded_nm": ("nm", "frame", "of a ramp: commanded defocus"),
    "corrected_nm": ("nm", "frame", "of a ramp: introduced defocus with what was found"),
    "estimated_nm": ("nm", "frame", "of a ramp: estimate of every frame"),
}
CHECKS = {
    "frames of one kind": ("as that of `calibrate`", ""),
    "motion of the star": ("as that of `calibrate`", ""),
    "everything explained": ("whether the verdict leaves nothing significant unexplained", ""),
}


def _wavefront_of(value: Any) -> Any:
    """Return coefficients as they are, Noll index to nm RMS, and those in the results of a run for its path.

    That is a run folder or its ``results.json``: of its diagnosis the wavefront with what was found, else
    that of its calibration. A ValueError says where none can be read.
    """
    if not isinstance(value, str):
        return value
    path = Path(value)
    path = RunFolder(path).results if path.is_dir() else path
    try:
        stages = json.loads(read_regular(path))["stages"]
    except OSError as error:
        raise ValueError(
            f"{path}: {error.strerror or error}; give a run folder or its results.json"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: no results of a run; give a run folder or its results.json") from None
    if "diagnose" in stages and "zernike_nm" in stages["diagnose"]:
        return stages["diagnose"]["zernike_nm"]["after"]
    if "calibrate" in stages:
        return stages["calibrate"]["all_zernike_nm"]
    raise ValueError(f"{path}: no calibration and no diagnosis of a cube; give a run that has one")


class Config(StageConfig):
    """Settings of the diagnosis."""

    input: str = item("cube", "recipe input that holds the cubes, or the ramp")
    highest_noll: int = item(
        66, "modes 2 to this belong to every model; beyond: high_order_ncpa", ge=4, le=HIGHEST_NOLL
    )
    held_out: float = item(
        0.25, "part of the frames, or of the pixels of fewer than 16, that no fit sees", gt=0.05, le=0.5
    )
    most_names: int = item(4, "names at which to stop, of each star and night", ge=1, le=10)
    recordings: Literal["auto", "together", "apart"] = item(
        "auto", "of one star and night (together), each of its own (apart), or as targets and times tell"
    )
    night_drift_nm: float = item(
        DRIFT_NM, "prior σ of the change of every mode between stars and nights [nm]", gt=0, le=100
    )
    sure_sigma: float = item(5.0, "significance of a detection", ge=3, le=20)
    begin_near: Annotated[dict[Noll, Nanometres], BeforeValidator(_wavefront_of)] = item(
        {},
        "a wavefront from which the fit begins as well, Noll index to nm RMS, or the path of a "
        "run that found it in another recording",
    )


class AdjustedRow(ResultsPart):
    """An effect that makes the final model fit better and is not named."""

    effect: str = item("", "Its label there.")
    phrase: str = item("", "The effect with its size and error, as a sentence names it.")
    parameters: EffectValues = item({}, "Values and standard errors by name of the parameter.")
    sigma: EffectValues = item({}, DITTO)
    opposite: records.OppositeSide | None = item(
        None, "Its opposite side, where these data do not exclude that."
    )


class StepRow(ResultsPart):
    """An effect, in the order found."""

    effect: str = item("", "Name of the effect.")
    indistinguishable: list[str] = item([], "Names of the `alternatives`.")
    alternatives: list[records.Alternative] = item([], "Effects that these data do not distinguish from it.")
    parameters: EffectValues = item({}, "Values and standard errors by name of the parameter.")
    sigma: EffectValues = item({}, DITTO)
    phrase: str = item("", "The effect with its size and error, as a sentence names it.")
    shown: EffectValues = item(
        {},
        "The same for readers: of petals differences from their mean, of a table of modes the RMS as well.",
    )
    shown_sigma: EffectValues = item({}, DITTO)
    significance: Number = item(nan, "Significance in Gaussian σ.")
    explained: Number = item(nan, "Part of the excess over noise that was there before.")
    held_out_z: Number = item(nan, "Vuong's statistic on the held-out frames.")
    gap_before: Number = item(nan, "Gap without and with it.")
    gap_after: Number = item(nan, DITTO)
    ranking: list[records.Ranked] = item([], "Candidates when it was chosen, the best first.")
    share: Number = item(nan, "Part of its own signal that the final model explains where that signal lies.")
    unusual: list[str] = item([], "Parameters beyond what is usual for the effect.")
    recordings: list[str] = item([], "Where it was found; empty: in all.")
    opposite: records.OppositeSide | None = item(
        None, "Its opposite side, where these data do not exclude that."
    )


class Change(ResultsPart):
    """A number with the model as it was, and with what was found."""

    before: Number = item(nan, "With the model as it was, and with what was found.")
    after: Number = item(nan, DITTO)

    @classmethod
    def of(cls, pair: Sequence[float]) -> "Change":
        """Return the change of a `pair` of before and after."""
        return cls(before=pair[0], after=pair[1])


class ModesChange(ResultsPart):
    """Coefficients with the model as it was, and with what was found."""

    before: ByNoll = item({}, "With the model as it was, and with what was found, by Noll index [nm RMS].")
    after: ByNoll = item({}, DITTO)


class FrameCounts(ResultsPart):
    """Frames that the fits saw, and those held out."""

    training: int = item(0, "Frames that the fits saw, and those that no fit has seen.")
    held_out: int = item(0, DITTO)


class DiagnoseResults(StageResults):
    """What the model of cubes or a ramp lacks; some keys are of cubes only, `defocus_error_nm` of a ramp."""

    stage: ClassVar[str] = "diagnose"
    verdict: str = item("", "``none``, ``effect`` or ``unknown``.")
    grade: str = item(
        "",
        "``none``, ``complete``, ``partial``, ``resembles`` or ``unknown``, see "
        "`diagnosis.verdict.Diagnosis`.",
    )
    sentence: str = item("", "The verdict in words, with sizes and errors.")
    steps: list[StepRow] = item([], "Effects that are named, in the order found.")
    nearest: StepRow | None = item(None, "What comes nearest, where the verdict is unknown.")
    gap: records.Gap = records.Gap()
    unexplained: bool = item(False, "Whether a significant part of the residual is left.")
    why_unknown: str = item("", "Why nothing is named; empty where something is, or nothing is missing.")
    rest: records.Rest | None = item(None, "What the model with the effects still misses.")
    adjusted: list[AdjustedRow] = item([], "Effects in the final model that are not named.")
    open_facts: dict[str, EffectValues] = item(
        {},
        "Facts of the instrument that `model` leaves free beside the steps and what is adjusted, as they "
        "are off by more than 1.5 standard errors; only where all had to be free. Their values, by effect.",
    )
    tried: list[records.Tried] = item([], "Every effect of the catalogue, and what became of it.")
    untestable: list[str] = item([], "Effects that the free parameters absorb.")
    recordings: list[records.Star] = item(
        [], "Stars and nights, where there are several; `sharing` says what they share."
    )
    sharing: list[records.SharingRow] = item([], "Which effects stars and nights share.")
    second_recording: dict[str, records.Advice] = item(
        {}, "A second recording that would show it, by effect of `untestable`."
    )
    mdb: dict[str, EffectValues] = item({}, "Smallest detectable size of every effect that was not found.")
    model: str = item("", "File with the model and what was found.")
    noise: records.NoiseVerdict | None = None
    fine_structure: records.FineStructure | None = None
    chi2_nu: Change = item(Change(), "Reduced χ² of the mean image, and its excess in σ.")
    excess_sigma: Change = item(Change(), DITTO)
    motion_ratio: Number = item(nan, "Image motion over its expectation; drift in σ.")
    drift_significance: Number = item(nan, DITTO)
    frames: FrameCounts = FrameCounts()
    held_out: str = item("frames", "``frames`` or ``pixels``: what no fit has seen.")
    added_wavefront: MapSize = item(
        MapSize(), "RMS and peak to valley of the wavefront that what was found adds."
    )
    zernike_nm: ModesChange = item(
        ModesChange(), "Total static wavefront [nm RMS]; `sigma_nm` its standard errors."
    )
    sigma_nm: ByNoll = item(
        {}, "Standard errors of `zernike_nm` with what was found, by Noll index [nm RMS]."
    )
    defocus_error_nm: Change = item(Change(), "RMS of estimated minus introduced defocus of a ramp.")
    seconds: Number = item(nan, "Time of the diagnosis.")


Results = DiagnoseResults
run = late("irlos_pipe.stages.diagnose.work")
