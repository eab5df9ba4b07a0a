"""The verdict in one or two sentences."""

from __future__ import annotations

from collections.abc import Sequence

from irlos_pipe.diagnosis.sharing import Together
from irlos_pipe.diagnosis.verdict import NONE, PARTIAL, RESEMBLES, UNKNOWN, Diagnosis, Step
from irlos_pipe.effects import CATALOGUE

OFF = 5.0  # standard errors from which a fact is said to be other than told


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict of a diagnosis in one or two sentences."""
    return f"{_found(diagnosis)}{_advised(diagnosis)}{_weaker(diagnosis)}"


def _weaker(diagnosis: Diagnosis) -> str:
    """What held-out pixels cannot say."""
    if diagnosis.held_out == "frames":
        return ""
    return (
        f" Too few frames to hold some out ({diagnosis.frames[0]}): pixels that no fit has seen judge, "
        "errors come from the noise as told, scaled by the misfit, and neither speckles that did not average "
        "out nor changes with time can be distinguished from what the model lacks."
    )


def _found(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == NONE:
        return f"Nothing significant is missing in the model{_limit(diagnosis)}."
    if diagnosis.verdict == UNKNOWN:
        return f"{_unnamed(diagnosis)}: {diagnosis.why_unknown}. {diagnosis.rest.text}."
    lacking = _listed([f"{_phrase(step)}{_where(diagnosis, step)}" for step in diagnosis.steps])
    return f"Missing in the model: {lacking}{_others(diagnosis.steps)}; {_left(diagnosis)}."


def _listed(phrases: Sequence[str]) -> str:
    """Several phrases, which may have commas of their own, as a sentence lists them."""
    if len(phrases) < 3:
        return " and ".join(phrases)
    return f"{'; '.join(phrases[:-1])}; and {phrases[-1]}"


def _unnamed(diagnosis: Diagnosis) -> str:
    """That something is missing, and what it resembles."""
    nearest = diagnosis.nearest
    if diagnosis.grade == RESEMBLES and nearest is not None:
        return f"Something is missing that resembles {_phrase(nearest)} and is not that"
    near = "" if nearest is None else f" (the nearest is {_phrase(nearest)})"
    return f"Something is missing that nothing in the catalogue explains{near}"


def _left(diagnosis: Diagnosis) -> str:
    """What is missing besides the names."""
    if diagnosis.grade == PARTIAL:
        return f"something else is missing as well: {diagnosis.rest.text}{_adjusted(diagnosis)}"
    if diagnosis.unexplained:
        return "besides, the pixels hold structure finer than the telescope can make, as of a wrong flat"
    return f"nothing else is missing{_limit(diagnosis)}"


def _adjusted(diagnosis: Diagnosis) -> str:
    """Facts that the data want otherwise, within what any instrument may have."""
    facts = [one for one in diagnosis.adjusted if one.effect.base.fact and one.significance > OFF]
    if not facts:
        return ""
    return f"; not named, as it may take up a part of that: {', '.join(one.phrase for one in facts)}"


def _phrase(step: Step) -> str:
    """A name with its size."""
    return step.phrase


def _where(diagnosis: Diagnosis, step: Step) -> str:
    """In which recordings a name is, and whether they share it."""
    together = diagnosis.together
    if together is None:
        return ""
    named = step.found_in(together.moments)
    where = f"in {' and '.join(named)}" if named else f"in all {len(together.moments.by_number)} recordings"
    findings = [one.finding for one in together.sharing if step.label in one.labels]
    words = {
        "common": "one value for all",
        "differs": "not in the others" if _alone(together, step) else "each recording has its own",
        "open": "the others would not show it",
    }
    return f" ({', '.join([where, *(words[one] for one in findings)])})"


def _alone(together: Together, step: Step) -> bool:
    """Whether the recordings in which a name is not found do not show it."""
    (sharing,) = (one for one in together.sharing if step.label in one.labels)
    return len(sharing.labels) == 1 and step.effect.acts_in is not None


def _advised(diagnosis: Diagnosis) -> str:
    """Which further recording would show what this one hides."""
    by_recording: dict[str, list[str]] = {}
    for name, advice in diagnosis.advice.items():
        by_recording.setdefault(advice.recording, []).append(name)
    shown = [
        f"{', '.join(names)} (a second recording {recording} would show it)"
        for recording, names in by_recording.items()
    ]
    return f" Untestable here: {'; '.join(shown)}." if shown else ""


def _others(steps: Sequence[Step]) -> str:
    others = [f"{step.label}: {other.name}" for step in steps for other in step.alternatives]
    return f" (not distinguished from {', '.join(others)})" if others else ""


def _limit(diagnosis: Diagnosis) -> str:
    kinds = [kind for kind in reversed(CATALOGUE.values()) if kind.limit and diagnosis.mdb.get(kind.name)]
    limits = [kind.limit.format(**diagnosis.mdb[kind.name]) for kind in kinds]
    return f" above {' or '.join(limits)}" if limits else ""
