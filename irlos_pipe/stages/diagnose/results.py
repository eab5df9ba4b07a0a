"""Results of stage `diagnose`."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import ClassVar

from irlos_pipe.diagnosis.records import Advice, Alternative, FineStructure, OppositeSide, Ranked
from irlos_pipe.optics.image_quality import CURVES
from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.product.results import DITTO, ByNoll, EffectValues, Number, ResultsPart, StageResults, item

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


class GapRow(ResultsPart):
    """``Σ|measured − predicted| / Σ measured`` of the held-out frames."""

    before: Number = item(nan, "With the model as it was, and with what was found.")
    after: Number = item(nan, DITTO)
    floor: Number = item(nan, "What noise alone leaves.")
    shrink: Number = item(nan, "(before − after) / (before − floor).")


class TriedRow(ResultsPart):
    """What became of an effect of the catalogue, see `diagnosis.verdict.Tried`."""

    effect: str = item("", "Name of the effect.")
    outcome: str = item(
        "",
        "``named``; ``nearest``, where the verdict is unknown; ``modelled`` from the start; ``adjusted``, "
        "not named; ``fitted``, explains less; ``scored``, not significant; ``absorbed``, not to be seen; "
        "``not tried``.",
    )
    significance: Number = item(
        nan, "Of its score test at the last model for which a name was looked for, in Gaussian σ."
    )
    reason: str = item("", "Why, in words.")


class AdjustedRow(ResultsPart):
    """An effect that makes the final model fit better and is not named."""

    effect: str = item("", "Its label there.")
    phrase: str = item("", "The effect with its size and error, as a sentence names it.")
    parameters: EffectValues = item({}, "Values and standard errors by name of the parameter.")
    sigma: EffectValues = item({}, DITTO)
    opposite: OppositeSide | None = item(None, "Its opposite side, where these data do not exclude that.")


class StepRow(ResultsPart):
    """An effect, in the order found."""

    effect: str = item("", "Name of the effect.")
    indistinguishable: list[str] = item([], "Names of the `alternatives`.")
    alternatives: list[Alternative] = item([], "Effects that these data do not distinguish from it.")
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
    ranking: list[Ranked] = item([], "Candidates when it was chosen, the best first.")
    share: Number = item(nan, "Part of its own signal that the final model explains where that signal lies.")
    unusual: list[str] = item([], "Parameters beyond what is usual for the effect.")
    recordings: list[str] = item([], "Where it was found; empty: in all.")
    opposite: OppositeSide | None = item(None, "Its opposite side, where these data do not exclude that.")


class OwnValueRow(ResultsPart):
    """What one star and night has of an effect, see `diagnosis.sharing.OwnValue`."""

    recording: str = item("", "Name of the star and night.")
    parameters: EffectValues = item({}, "Values and standard errors by name of the parameter.")
    sigma: EffectValues = item({}, DITTO)
    significance: Number = item(nan, "Of its presence there, in Gaussian σ.")


class SharingRow(ResultsPart):
    """Whether stars and nights share an effect, see `diagnosis.sharing.Sharing`."""

    effect: str = item("", "Name of the effect.")
    finding: str = item("", "``common``, ``differs``, or ``open`` where these data do not tell.")
    significance: Number = item(nan, "Of the differences, in Gaussian σ.")
    chi2_fall: Number = item(nan, "By which χ² falls with a value of each, for so many more `parameters`.")
    parameters: int = item(0, "Further parameters that values of each take.")
    held_out_z: Number = item(nan, "Vuong's statistic for a value of each against one for all.")
    values: list[OwnValueRow] = item([], "What each star and night has of it.")


class StarRow(ResultsPart):
    """One star and night, see `diagnosis.view.Moment`, and by how much its wavefront differs."""

    name: str = item("", "Name of the star and night, and of the star.")
    star: str = item("", DITTO)
    ncpa_change_nm: Number = item(
        nan, "RMS over the modes of the change from the common wavefront, and of its standard errors."
    )
    sigma_nm: Number = item(nan, DITTO)


class NoiseRow(ResultsPart):
    """Whether the noise model holds, see `diagnosis.checks.noise.NoiseVerdict`."""

    kind: str = item("", "``photon-limited``, ``speckle-limited``, or ``unseen`` of a single frame.")
    bright_ratio: Number = item(nan, "Measured over predicted variance of bright and of faint pixels.")
    faint_ratio: Number = item(nan, DITTO)
    holds: bool = item(True, "Whether the noise model explains the scatter of the frames.")
    text: str = item("", "The same in words.")


class Change(ResultsPart):
    """A number with the model as it was, and with what was found."""

    before: Number = item(nan, "With the model as it was, and with what was found.")
    after: Number = item(nan, DITTO)

    @classmethod
    def of(cls, pair: Sequence[float]) -> Change:
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


class WhereRow(ResultsPart):
    """The strongest part of what is left, from the star, x to the right and y up [mas]."""

    x_mas: Number = item(nan, "Position from the star, to the right and up.")
    y_mas: Number = item(nan, DITTO)
    extent_mas: Number = item(nan, "Diameter of a disc as large.")


class RestRow(ResultsPart):
    """What the model still misses, see `diagnosis.verdict.Rest`."""

    light_fraction: Number = item(nan, "Part of the light that is misplaced beyond what noise alone shows.")
    where: WhereRow = WhereRow()
    excess: bool = item(False, "Whether the strongest part is too bright in the data, not too faint.")
    symmetry: str = item(
        "", "``symmetric``, ``antisymmetric`` or ``one-sided``, under a half turn about the star."
    )
    time: str = item(
        "", "Whether the two halves of the frames leave the same: ``static``, ``moving`` or ``not seen``."
    )
    finer_than_diffraction: bool = item(False, "Whether a part of it is finer than the telescope can make.")
    flat_rms: Number = item(
        0.0, "Relative error of the flat that would make what is finer; 0 where none is distinguished."
    )
    text: str = item("", "All of it in a sentence.")


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
    gap: GapRow = GapRow()
    unexplained: bool = item(False, "Whether a significant part of the residual is left.")
    why_unknown: str = item("", "Why nothing is named; empty where something is, or nothing is missing.")
    rest: RestRow | None = item(None, "What the model with the effects still misses.")
    adjusted: list[AdjustedRow] = item([], "Effects in the final model that are not named.")
    open_facts: dict[str, EffectValues] = item(
        {},
        "Facts of the instrument that `model` leaves free beside the steps and what is adjusted, as they "
        "are off by more than 1.5 standard errors; only where all had to be free. Their values, by effect.",
    )
    tried: list[TriedRow] = item([], "Every effect of the catalogue, and what became of it.")
    untestable: list[str] = item([], "Effects that the free parameters absorb.")
    recordings: list[StarRow] = item(
        [], "Stars and nights, where there are several; `sharing` says what they share."
    )
    sharing: list[SharingRow] = item([], "Which effects stars and nights share.")
    second_recording: dict[str, Advice] = item(
        {}, "A second recording that would show it, by effect of `untestable`."
    )
    mdb: dict[str, EffectValues] = item({}, "Smallest detectable size of every effect that was not found.")
    model: str = item("", "File with the model and what was found.")
    noise: NoiseRow | None = None
    fine_structure: FineStructure | None = None
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
