"""What stage `diagnose` reports of cubes: results, check, arrays, summary, the model with what was found."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.diagnosis.sharing import Together
from irlos_pipe.diagnosis.verdict import UNKNOWN, Diagnosis, Pictures, Step, sentence
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.frames.recording import star_position
from irlos_pipe.optics.image_quality import power_spectrum, quality_curves
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.product.product import Check, Quantity, declared
from irlos_pipe.stages.base import ModelConfig
from irlos_pipe.stages.diagnose.stage import (
    ARRAYS,
    AdjustedRow,
    Change,
    DiagnoseResults,
    FrameCounts,
    ModesChange,
    StepRow,
)
from irlos_pipe.stages.model.untested import LOOKED_AT_ELSEWHERE, untested_by_cubes

MODEL_FILE = "model.yaml"


def diagnose_results(result: Diagnosis, diversity_nm: Mapping[int, float]) -> DiagnoseResults:
    """Return the `result` of a diagnosis of cubes that were taken with a diversity `diversity_nm`."""
    modes = [_by_noll(result, one) for one in result.modes_nm]
    return DiagnoseResults.filled_from(
        result,
        untested=untested_by_cubes(diversity_nm, LOOKED_AT_ELSEWHERE),
        sentence=sentence(result),
        steps=[_step(step, result.together) for step in result.steps],
        nearest=None if result.nearest is None else _step(result.nearest, result.together),
        open_facts={one.name: one.base.describe(one.values) for one in result.open_facts},
        adjusted=[
            AdjustedRow.filled_from(one, effect=one.label, parameters=one.public) for one in result.adjusted
        ],
        tried=list(result.tried),
        untestable=list(result.untestable),
        recordings=list(result.together.stars) if result.together else [],
        sharing=list(result.together.sharing.values()) if result.together else [],
        second_recording=dict(result.advice),
        model=MODEL_FILE,
        fine_structure=result.fine,
        chi2_nu=Change.of(result.chi2_nu),
        excess_sigma=Change.of(result.excess_sigma),
        frames=FrameCounts(training=result.frames[0], held_out=result.frames[1]),
        added_wavefront=MapSize.of(result.pictures.added_opd_nm),
        zernike_nm=ModesChange(before=modes[0], after=modes[1]),
        sigma_nm=_by_noll(result, result.modes_sigma_nm),
        seconds=round(result.seconds, 3),
    )


def checks_of(results: DiagnoseResults) -> list[Check]:
    """Return the check of a diagnosis: that the model with what was named in `results` lacks nothing."""
    explained = results.verdict != UNKNOWN and not results.unexplained
    grade = f", {results.grade}" if results.grade and results.grade != results.verdict else ""
    rest = results.rest.text if results.rest else ""
    left = "" if explained else results.why_unknown or rest  # the whole sentence stands beside it
    message = f"{results.verdict}{grade}: {left or results.sentence}"
    return [Check("everything explained", float(explained), "", 1.0, None, message)]


def _step(step: Step, together: Together | None = None) -> StepRow:
    return StepRow.filled_from(
        step,
        effect=step.label,
        indistinguishable=[other.name for other in step.alternatives],
        alternatives=list(step.alternatives),
        parameters=step.public,
        shown=step.shown or step.public,
        shown_sigma=step.shown_sigma or step.sigma,
        held_out_z=step.preference,
        gap_before=step.gap.before,
        gap_after=step.gap.after,
        ranking=list(step.ranking),
        recordings=[] if together is None else step.found_in(together.moments),
    )


def _by_noll(result: Diagnosis, values: np.ndarray) -> dict[int, float]:
    both = zip(result.nolls, values.tolist(), strict=True)
    return {noll: value for noll, value in both if noll <= HIGHEST_REPORTED_NOLL}


def diagnose_arrays(result: Diagnosis) -> dict[str, Quantity]:
    """Return images, maps and modes of a diagnosis of cubes."""
    pictures, (before, after) = result.pictures, result.modes_nm
    values = {
        "measured_e": (pictures.measured_e, np.where(np.isfinite(pictures.sigma_e), pictures.sigma_e, 0.0)),
        "before_e": pictures.before_e,
        "after_e": pictures.after_e,
        "leading_mode": pictures.leading,
        "added_opd_nm": pictures.added_opd_nm,
        "added_amplitude": pictures.added_amplitude,
        "noll": result.nolls,
        "zernike_before_nm": before,
        "zernike_after_nm": (after, result.modes_sigma_nm),
    }
    return declared(ARRAYS, values)


def summary_lines(result: Diagnosis) -> list[str]:
    """Return the lines for the terminal."""
    gap, held_out = result.gap, result.held_out
    lines = [f"diagnosis       {result.verdict}: {sentence(result)}"]
    lines.append(
        f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} "
        f"(held-out {held_out}), χ²/ν {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}, "
        f"{result.seconds:.0f} s"
    )
    if result.unexplained:
        lines.append(f"  left            {result.rest.text}")
    for step in result.steps:
        if step.unusual:
            lines.append(f"  unusual         {step.label}: {', '.join(step.unusual)} beyond what is usual")
    if result.open_facts:
        lines.append(f"  free as well    {', '.join(one.name for one in result.open_facts)} in {MODEL_FILE}")
    lines.append(f"  noise           {result.noise.text}")
    fine = result.fine
    lines.append(f"  finer than D/λ  {fine.ratio:.2f} × what noise leaves there, {fine.significance:.1f} σ")
    return lines


# -- OTF, encircled energy, and power of what is left, measured and predicted ------------------------


def quality_arrays(pictures: Pictures, settings: PsfSettings) -> dict[str, Quantity]:
    """Return the curves of the mean held-out image and of its predictions, `pictures` under `settings`.

    Pixels that are not used hold the prediction after in all three. Light is that of the window.
    """
    used = np.isfinite(pictures.sigma_e) & (pictures.sigma_e > 0)
    resolution_px, scale_mas = settings.resolution_px, settings.pixel_scale_mas
    images = {"measured": pictures.measured_e, "before": pictures.before_e, "after": pictures.after_e}
    centre = star_position(np.nan_to_num(pictures.after_e))
    whole = {name: np.where(used, image, pictures.after_e) for name, image in images.items()}
    arrays = quality_curves(whole, centre, resolution_px, scale_mas, of_window=True)
    for name in ("before", "after"):
        left = np.where(
            used, (pictures.measured_e - images[name]) / np.where(used, pictures.sigma_e, 1), np.nan
        )
        power = power_spectrum(left, resolution_px)
        arrays |= {"left_frequency": power.at, f"left_power_{name}": power.value}
    return declared(ARRAYS, arrays)


# -- the model with what was found -------------------------------------------------------------


def model_yaml(model: ModelConfig, entries: Sequence[dict[str, Any]]) -> bytes:
    """Return the section `model` of a recipe with `entries` added to its effects, as YAML."""
    section = model.model_dump(mode="json")
    section["effects"] = _with_one_list_of_pixels([*section["effects"], *entries])
    return yaml.safe_dump(section, sort_keys=False, allow_unicode=True).encode()


def _with_one_list_of_pixels(effects: list[Any]) -> list[Any]:
    """Entries of which a single one lists all bad pixels."""
    (name,) = (name for name, kind in CATALOGUE.items() if kind.found_by == "pixels")
    listed = [entry[name]["pixels"] for entry in effects if isinstance(entry, dict) and name in entry]
    if len(listed) < 2:
        return effects
    others = [entry for entry in effects if not (isinstance(entry, dict) and name in entry)]
    pixels = sorted({tuple(pixel) for part in listed for pixel in part})
    return [*others, {name: {"pixels": [list(pixel) for pixel in pixels]}}]


def model_entries(result: Diagnosis) -> list[dict[str, Any]]:
    """Return what a diagnosis found, adjusted or leaves free, common to its recordings, as entries."""
    found = [one.effect for one in (*result.steps, *result.adjusted)]
    return [recipe_entry(one) for one in (*found, *result.open_facts) if one.acts_in is None]


def recipe_entry(effect: FixedEffect) -> dict[str, Any]:
    """Return an effect as an entry of the section: values to start from, fitted where that helps."""
    kind, public = CATALOGUE[effect.name], effect.base.describe(effect.values)
    values = {p.name: _plain(public[p.name]) for p in kind.public if p.name in public}
    words = {o.name: getattr(effect.base, o.name) for o in kind.options if o.kind == "word"}
    options = {name: word for name, word in words.items() if word}
    return {effect.name: values | options | ({"fit": True} if kind.found_by == "score" else {})}


def _plain(value: Any) -> Any:
    """Value as in the YAML of a recipe: tables by integer."""
    return {int(key): one for key, one in value.items()} if isinstance(value, dict) else value
