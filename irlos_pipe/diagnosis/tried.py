"""What was tried of the catalogue, and why the rest was not named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from irlos_pipe.diagnosis.acceptance import Accepted, Options, Search
from irlos_pipe.diagnosis.records import Ranked
from irlos_pipe.diagnosis.search.scores import Score
from irlos_pipe.diagnosis.verdict import Outcome, Tried
from irlos_pipe.effects import CATALOGUE

ELSEWHERE = {
    "frames": "sought in the estimates of single frames, and not significant there",
    "noise": "belongs to the noise of the frames, in which no diagnosis looks for patterns",
    "pixels": "sought pixel by pixel, and not found",
    "ramp": "acts on the introduced defocus: only a ramp shows it",
}


def tried(search: Search, options: Options, hidden: Sequence[Score], *, named: bool) -> list[Tried]:
    """Return every effect of the catalogue with what became of it, in the order of the catalogue.

    Parameters
    ----------
    search : Search
    options : Options
    hidden : sequence of Score
        Effects that the free parameters absorb, or that would be seen only beyond their bounds.
    named : bool
        Whether what was accepted is named; else it is what comes nearest.
    """
    story = _Story(search, options, [one.name for one in hidden], named)
    return [story.of(name) for name in CATALOGUE]


@dataclass(frozen=True)
class _Story:
    search: Search
    options: Options
    hidden: Sequence[str]
    named: bool

    def of(self, name: str) -> Tried:
        """What became of one effect."""
        score = next((one for one in self.search.scores if one.name == name), None)
        outcome, reason = self._fate(name, score)
        return Tried(name, outcome, float("nan") if score is None else score.significance, reason)

    def _fate(self, name: str, score: Score | None) -> tuple[Outcome, str]:
        if name in [*(one.name for one in self.search.accepted), *self._drifting()]:
            return ("named", "") if self.named else ("nearest", "fitted, and leaves too much to be named")
        if any(effect.name == name for effect in self.search.null.fitted.effects):
            return "modelled", "in the model from the start"
        if any(effect.name == name for effect in self.search.final.fitted.effects):
            return "adjusted", "the model fits better with it, but it is not sure enough to be named"
        for one in self.search.accepted:
            for other in one.ranking[1:]:
                if other.name == name:
                    return "fitted", _lost(one, other)
        if score is not None:
            return self._scored(score)
        return "not tried", self._not_tried(name)

    def _drifting(self) -> list[str]:
        """Name of the drift, if it is significant."""
        drift = self.search.drift
        return [drift.effect().name] if drift and drift.significance > self.options.sure else []

    def _scored(self, score: Score) -> tuple[Outcome, str]:
        if score.name in self.hidden:
            part = score.observability
            return "absorbed", f"the free parameters imitate all but {part:.1%} of what it does to the image"
        sure, seen = self.options.sure, f"{max(score.significance, 0.0):.1f} σ in what is left"
        if score.significance > sure:
            return "scored", f"{seen}; fitted, it explains too little of that"
        return "scored", f"{seen}, {sure:g} σ are asked"

    def _not_tried(self, name: str) -> str:
        kind = CATALOGUE[name]
        if name in self.search.meaningless:
            return "means nothing for this instrument or these recordings"
        if kind.widens:
            return f"a wider form of {kind.widens}, tried where that is found"
        return ELSEWHERE.get(kind.found_by, "not tried")


def _lost(best: Accepted, other: Ranked) -> str:
    """By how much a name lost against the one that was chosen."""
    first = best.ranking[0]
    why = f"explains {other.explained:.1%} where {first.name} explains {first.explained:.1%}"
    if other.name in [one.name for one in best.alternatives]:
        return f"{why}: not distinguished from it"
    return f"{why}; Δχ² {first.gain - other.gain:.3g}, on data that no fit has seen z {other.held_out_z:.1f}"
