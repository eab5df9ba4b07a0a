"""Results of stage `diagnose`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from irlos_pipe.diagnosis.records import Advice, Alternative, FineStructure, OppositeSide, Ranked
from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.product.results import ByNoll, EffectValues, Number, ResultsPart, StageResults

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
    "encircled_radius_mas": ("mas", "radius", "radius of circles about the star"),
    "encircled_<image>": ("", "radius", "part of the light within a circle"),
    "otf_x_frequency": ("D/λ", "frequency", "spatial frequency along x"),
    "otf_y_frequency": ("D/λ", "frequency", "spatial frequency along y"),
    "otf_x_<image>": ("", "frequency", "modulus of the OTF along x"),
    "otf_y_<image>": ("", "frequency", "modulus of the OTF along y"),
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
    """``Σ|measured − predicted| / Σ measured`` of the held-out frames.

    Attributes
    ----------
    before, after : float
        With the model as it was, and with what was found.
    floor : float
        What noise alone leaves.
    shrink : float
        (before − after) / (before − floor).
    """

    before: Number = math.nan
    after: Number = math.nan
    floor: Number = math.nan
    shrink: Number = math.nan


class TriedRow(ResultsPart):
    """What became of an effect of the catalogue, see `diagnosis.verdict.Tried`.

    Attributes
    ----------
    effect : str
        Name of the effect.
    outcome : str
        ``named``; ``nearest``, where the verdict is unknown; ``modelled`` from the start; ``adjusted``,
        not named; ``fitted``, explains less; ``scored``, not significant; ``absorbed``, not to be seen;
        ``not tried``.
    significance : float
        Of its score test at the last model for which a name was looked for, in Gaussian σ.
    reason : str
        Why, in words.
    """

    effect: str = ""
    outcome: str = ""
    significance: Number = math.nan
    reason: str = ""


class AdjustedRow(ResultsPart):
    """An effect that makes the final model fit better and is not named.

    Attributes
    ----------
    effect : str
        Its label there.
    phrase : str
        The effect with its size and error, as a sentence names it.
    parameters, sigma : dict
        Values and standard errors by name of the parameter.
    opposite : OppositeSide or None
        Its opposite side, where these data do not exclude that.
    """

    effect: str = ""
    phrase: str = ""
    parameters: EffectValues = {}
    sigma: EffectValues = {}
    opposite: OppositeSide | None = None


class StepRow(ResultsPart):
    """An effect, in the order found.

    Attributes
    ----------
    effect : str
        Name of the effect.
    indistinguishable : list of str
        Names of the `alternatives`.
    alternatives : list of Alternative
        Effects that these data do not distinguish from it.
    parameters, sigma : dict
        Values and standard errors by name of the parameter.
    phrase : str
        The effect with its size and error, as a sentence names it.
    shown, shown_sigma : dict
        The same for readers: of petals differences from their mean, of a table of modes the RMS as well.
    significance : float
        Significance in Gaussian σ.
    explained : float
        Part of the excess over noise that was there before.
    held_out_z : float
        Vuong's statistic on the held-out frames.
    gap_before, gap_after : float
        Gap without and with it.
    ranking : list of Ranked
        Candidates when it was chosen, the best first.
    share : float
        Part of its own signal that the final model explains where that signal lies.
    unusual : list of str
        Parameters beyond what is usual for the effect.
    recordings : list of str
        Where it was found; empty: in all.
    opposite : OppositeSide or None
        Its opposite side, where these data do not exclude that.
    """

    effect: str = ""
    indistinguishable: list[str] = []
    alternatives: list[Alternative] = []
    parameters: EffectValues = {}
    sigma: EffectValues = {}
    phrase: str = ""
    shown: EffectValues = {}
    shown_sigma: EffectValues = {}
    significance: Number = math.nan
    explained: Number = math.nan
    held_out_z: Number = math.nan
    gap_before: Number = math.nan
    gap_after: Number = math.nan
    ranking: list[Ranked] = []
    share: Number = math.nan
    unusual: list[str] = []
    recordings: list[str] = []
    opposite: OppositeSide | None = None


class OwnValueRow(ResultsPart):
    """What one star and night has of an effect, see `diagnosis.sharing.OwnValue`.

    Attributes
    ----------
    recording : str
        Name of the star and night.
    parameters, sigma : dict
        Values and standard errors by name of the parameter.
    significance : float
        Of its presence there, in Gaussian σ.
    """

    recording: str = ""
    parameters: EffectValues = {}
    sigma: EffectValues = {}
    significance: Number = math.nan


class SharingRow(ResultsPart):
    """Whether stars and nights share an effect, see `diagnosis.sharing.Sharing`.

    Attributes
    ----------
    effect : str
        Name of the effect.
    finding : str
        ``common``, ``differs``, or ``open`` where these data do not tell.
    significance : float
        Of the differences, in Gaussian σ.
    chi2_fall : float
        By which χ² falls with a value of each, for so many more `parameters`.
    parameters : int
        Further parameters that values of each take.
    held_out_z : float
        Vuong's statistic for a value of each against one for all.
    values : list of OwnValueRow
        What each star and night has of it.
    """

    effect: str = ""
    finding: str = ""
    significance: Number = math.nan
    chi2_fall: Number = math.nan
    parameters: int = 0
    held_out_z: Number = math.nan
    values: list[OwnValueRow] = []


class StarRow(ResultsPart):
    """One star and night, see `diagnosis.moments.Moment`, and by how much its wavefront differs.

    Attributes
    ----------
    name, star : str
        Name of the star and night, and of the star.
    ncpa_change_nm, sigma_nm : float
        RMS over the modes of the change from the common wavefront, and of its standard errors.
    """

    name: str = ""
    star: str = ""
    ncpa_change_nm: Number = math.nan
    sigma_nm: Number = math.nan


class NoiseRow(ResultsPart):
    """Whether the noise model holds, see `diagnosis.checks.noise.NoiseVerdict`.

    Attributes
    ----------
    kind : str
        ``photon-limited``, ``speckle-limited``, or ``unseen`` of a single frame.
    bright_ratio, faint_ratio : float
        Measured over predicted variance of bright and of faint pixels.
    holds : bool
        Whether the noise model explains the scatter of the frames.
    text : str
        The same in words.
    """

    kind: str = ""
    bright_ratio: Number = math.nan
    faint_ratio: Number = math.nan
    holds: bool = True
    text: str = ""


class Change(ResultsPart):
    """A number with the model as it was, and with what was found.

    Attributes
    ----------
    before, after : float
        With the model as it was, and with what was found.
    """

    before: Number = math.nan
    after: Number = math.nan

    @classmethod
    def of(cls, pair: Sequence[float]) -> Change:
        """Return the change of a `pair` of before and after."""
        return cls(before=pair[0], after=pair[1])


class ModesChange(ResultsPart):
    """Coefficients with the model as it was, and with what was found.

    Attributes
    ----------
    before, after : dict of int to float
        With the model as it was, and with what was found, by Noll index [nm RMS].
    """

    before: ByNoll = {}
    after: ByNoll = {}


class FrameCounts(ResultsPart):
    """Frames that the fits saw, and those held out.

    Attributes
    ----------
    training, held_out : int
        Frames that the fits saw, and those that no fit has seen.
    """

    training: int = 0
    held_out: int = 0


class WhereRow(ResultsPart):
    """The strongest part of what is left, from the star, x to the right and y up [mas].

    Attributes
    ----------
    x_mas, y_mas : float
        Position from the star, to the right and up.
    extent_mas : float
        Diameter of a disc as large.
    """

    x_mas: Number = math.nan
    y_mas: Number = math.nan
    extent_mas: Number = math.nan


class RestRow(ResultsPart):
    """What the model still misses, see `diagnosis.rest.Rest`.

    Attributes
    ----------
    light_fraction : float
        Part of the light that is misplaced beyond what noise alone shows.
    excess : bool
        Whether the strongest part is too bright in the data, not too faint.
    symmetry : str
        ``symmetric``, ``antisymmetric`` or ``one-sided``, under a half turn about the star.
    time : str
        Whether the two halves of the frames leave the same: ``static``, ``moving`` or ``not seen``.
    finer_than_diffraction : bool
        Whether a part of it is finer than the telescope can make.
    flat_rms : float
        Relative error of the flat that would make what is finer; 0 where none is told apart.
    text : str
        All of it in a sentence.
    """

    light_fraction: Number = math.nan
    where: WhereRow = WhereRow()
    excess: bool = False
    symmetry: str = ""
    time: str = ""
    finer_than_diffraction: bool = False
    flat_rms: Number = 0.0
    text: str = ""


class DiagnoseResults(StageResults):
    """What the model of cubes or a ramp lacks; some keys stand only for cubes, `defocus_error_nm` for a ramp.

    Attributes
    ----------
    verdict : str
        ``none``, ``effect`` or ``unknown``.
    grade : str
        ``none``, ``complete``, ``partial``, ``resembles`` or ``unknown``, see `diagnosis.verdict.Diagnosis`.
    sentence : str
        The verdict in words, with sizes and errors.
    steps : list of StepRow
        Effects that are named, in the order found.
    nearest : StepRow or None
        What comes nearest, where the verdict is unknown.
    unexplained : bool
        Whether a significant part of the residual is left.
    why_unknown : str
        Why nothing is named; empty where something is, or nothing is missing.
    rest : RestRow or None
        What the model with the effects still misses.
    open_facts : dict
        Facts of the instrument that `model` leaves free beside the steps and what is adjusted, as they are
        off by more than 1.5 standard errors; only where all had to be free. Their values, by effect.
    adjusted : list of AdjustedRow
        Effects in the final model that are not named.
    tried : list of TriedRow
        Every effect of the catalogue, and what became of it.
    untestable : list of str
        Effects that the free parameters absorb.
    recordings : list of StarRow
        Stars and nights, where there are several; `sharing` says what they share.
    sharing : list of SharingRow
        Which effects stars and nights share.
    second_recording : dict of str to Advice
        A second recording that would show it, by effect of `untestable`.
    mdb : dict of str to dict
        Smallest detectable size of every effect that was not found.
    model : str
        File with the model and what was found.
    chi2_nu, excess_sigma : Change
        Reduced χ² of the mean image, and its excess in σ.
    motion_ratio, drift_significance : float
        Image motion over its expectation; drift in σ.
    held_out : str
        ``frames`` or ``pixels``: what no fit has seen.
    added_wavefront : MapSize
        RMS and peak to valley of the wavefront that what was found adds.
    zernike_nm : ModesChange
        Total static wavefront [nm RMS]; `sigma_nm` its standard errors.
    sigma_nm : dict of int to float
        Standard errors of `zernike_nm` with what was found, by Noll index [nm RMS].
    defocus_error_nm : Change
        RMS of estimated minus introduced defocus of a ramp.
    seconds : float
        Time of the diagnosis.
    """

    stage: ClassVar[str] = "diagnose"
    verdict: str = ""
    grade: str = ""
    sentence: str = ""
    steps: list[StepRow] = []
    nearest: StepRow | None = None
    gap: GapRow = GapRow()
    unexplained: bool = False
    why_unknown: str = ""
    rest: RestRow | None = None
    adjusted: list[AdjustedRow] = []
    open_facts: dict[str, EffectValues] = {}
    tried: list[TriedRow] = []
    untestable: list[str] = []
    recordings: list[StarRow] = []
    sharing: list[SharingRow] = []
    second_recording: dict[str, Advice] = {}
    mdb: dict[str, EffectValues] = {}
    model: str = ""
    noise: NoiseRow | None = None
    fine_structure: FineStructure | None = None
    chi2_nu: Change = Change()
    excess_sigma: Change = Change()
    motion_ratio: Number = math.nan
    drift_significance: Number = math.nan
    frames: FrameCounts = FrameCounts()
    held_out: str = "frames"
    added_wavefront: MapSize = MapSize()
    zernike_nm: ModesChange = ModesChange()
    sigma_nm: ByNoll = {}
    defocus_error_nm: Change = Change()
    seconds: Number = math.nan
