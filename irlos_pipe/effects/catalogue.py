"""The effects that recipes, models and results can name, and their page of the documentation."""

import inspect
import textwrap
from collections.abc import Sequence

import numpy as np

import irlos_pipe.effects.colour as colour
import irlos_pipe.effects.companion as companion
import irlos_pipe.effects.detector as detector
import irlos_pipe.effects.focus_stage as focus_stage
import irlos_pipe.effects.lenslet_images as lenslet_images
import irlos_pipe.effects.motion as motion
import irlos_pipe.effects.pupil_places as pupil_places
import irlos_pipe.effects.pupil_steps as pupil_steps
import irlos_pipe.effects.redrawn_pupil as redrawn_pupil
import irlos_pipe.effects.seeing_halo as seeing_halo
import irlos_pipe.effects.wavefront as wavefront
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Conditions, Public

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        motion.TipTiltJitter, motion.Vibration, seeing_halo.SeeingHalo, seeing_halo.UnevenResidual,
        seeing_halo.AoCutoff, colour.AtmosphericDispersion, colour.Spectrum, colour.PlateScale,
        colour.Anamorphism, wavefront.DiversityError, redrawn_pupil.PupilMisregistration,
        redrawn_pupil.PupilSizes, wavefront.AmplitudeAberration, pupil_places.PupilSpot,
        pupil_steps.LowWindEffect, pupil_steps.SegmentPiston, wavefront.HighOrderNcpa,
        pupil_places.PhaseBump, wavefront.NcpaDrift, wavefront.ChromaticNcpa, wavefront.FilterNcpa,
        companion.Companion, companion.Ghost, detector.InterpixelCrosstalk, detector.DetectorNonlinearity,
        detector.BackgroundGradient, detector.CorrelatedNoise, detector.BadPixels,
        focus_stage.FocusStageOffset, focus_stage.FocusStageScale, focus_stage.FocusStageHysteresis,
        focus_stage.HighAperture, lenslet_images.LensletImages,
    )
}  # fmt: skip

LINE_LENGTH = 118


def in_other_forms(
    name: str, conditions: Conditions, values: Sequence[float] | np.ndarray, *, wider: bool
) -> list[FixedEffect]:
    """Return the wider forms of the effect `name`, or that of which it is one, all free, where it acts at
    `values`.

    A `wider` form begins with its further parameters at zero; a narrower one leaves them out.
    """
    kinds = CATALOGUE.values()
    forms = [one for one in kinds if (one.widens == name if wider else CATALOGUE[name].widens == one.name)]
    found = []
    for base in (kind.under(conditions) for kind in forms):
        count = len(base.parameters)
        every = [one.name for one in base.parameters]
        found.append(FixedEffect(base, [*values, *[0.0] * count][:count], free=every))
    return found


def everyday(recordings: Sequence[Conditions], present: Sequence[Effect]) -> list[Effect]:
    """Facts of the instrument and mild effects, their values free, but for those that a mode imitates.

    They are stated for the first of the `recordings`. Of the two that scale the image one is free, the pixels
    unless it is `present` as the wavelength: jointly they drift far from what is true, a little here and a
    little there. The other is a rival in the end.
    """
    model, found = {effect.name for effect in present}, []
    held = colour.PlateScale.name if colour.Spectrum.name in model else colour.Spectrum.name
    for name, kind in CATALOGUE.items():
        if not (kind.fact or kind.mild) or name in model or name == held:
            continue
        try:
            effect = kind.under(recordings[0])
        except ValueError:
            continue  # it means nothing for this instrument
        if not effect.imitated_in(recordings):
            found.append(effect)
    return found


HEAD = """# Effects

The names, units and limits that recipes, models, simulation specifications, products and reports use. This
page is made from the classes in `irlos_pipe/effects`; [Extending](../extending.md) describes how to add one.

A recipe lists effects in `model.effects`: by name to estimate them, with their values to hold them
(`tip_tilt_jitter: {sigma_mas: 8}`), or with their values and `fit: true` to start there. Values in brackets
may be left out. Effects marked with * can be listed several times; results name the second `companion_2`.

Formulas: P(u) and Φ(u) are amplitude and OPD in the pupil, u in metres; an effect of the plane otf
multiplies the OTF at the baseline b by T(b); I(a) is the image, a an angle; s is the signal of a pixel, and
Z_k is Noll k.

| effect | plane | values: unit, limits | most easily mistaken for |
|---|---|---|---|
"""


def catalogue_page() -> str:
    """Return the page of the documentation that lists all effects, in Markdown."""
    kinds = CATALOGUE.values()
    rows = [
        f"| `{kind.name}`{'*' if kind.repeatable else ''} | {kind.plane} | "
        f"{'; '.join([*map(_value, kind.public), *(f'option {_value(one)}' for one in kind.options)])} | "
        f"{kind.look_alike} |"
        for kind in kinds
    ]
    sections = [
        "\n\n".join(
            [
                f"## {kind.name}",
                _summary(kind),
                f"```text\n{kind.formula}\n```",
                _filled(f"Reference: {kind.reference}."),
            ]
        )
        for kind in kinds
    ]
    return HEAD + "\n".join(rows) + "\n\n" + "\n\n".join(sections) + "\n"


def effect_text(kind: type[Effect]) -> str:
    """Return what an effect of a `kind` is, with its values, in lines."""
    values = [_value(one).replace("`", "") for one in kind.public]
    options = [f"option {_value(one)}".replace("`", "") for one in kind.options]
    return "\n".join(
        [
            *_summary(kind).replace("`", "").splitlines(),
            f"formula: {kind.formula}",
            *(f"value {text}" for text in values),
            *options,
            f"plane: {kind.plane}",
            f"mistaken for: {kind.look_alike}",
            f"reference: {kind.reference}",
        ]
    )


def _value(one: Public) -> str:
    name = f"`{one.name}`" if one.required else f"[`{one.name}`]"
    unit = " or ".join(one.choices) or one.unit
    limited = np.isfinite([one.lower, one.upper]).any()
    limits = f"{one.lower:g} to {one.upper:g}" if limited else ""
    return f"{name}: " + ", ".join(filter(None, [unit, limits])) if unit or limits else name


def _summary(kind: type[Effect]) -> str:
    """The docstring of an effect up to its first section."""
    text = inspect.cleandoc(kind.__doc__ or "")
    for section in ("Parameters\n---", "Parameters: ", "Raises `"):
        text = text.split(f"\n\n{section}")[0]
    text = text.strip().replace("``", "`")
    return "\n\n".join(_filled(paragraph) for paragraph in text.split("\n\n"))


def _filled(paragraph: str) -> str:
    return textwrap.fill(" ".join(paragraph.split()), LINE_LENGTH, break_on_hyphens=False)
