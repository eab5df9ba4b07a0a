"""States of the code that numbers were computed with: one for all experiments, unless others are told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.paper.run.tables import plain_table

OWN = "irlos_pipe"
COLUMNS = ("code", "finished", "experiments")


def states_of(results: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the experiments of every state of the code, in the order of the paper.

    Parameters
    ----------
    results : mapping
        Content of paper_results.json.
    """
    states: dict[str, list[str]] = {}
    for experiment, stages in results["runs"].items():
        code = " and ".join(sorted({made["software"][OWN] for made in stages.values()}))
        states.setdefault(code, []).append(experiment)
    return states


def require_one_state(results: Mapping[str, Any]) -> None:
    """Refuse numbers of several states of the code.

    Raises
    ------
    ConfigurationError
        That says which experiments are of which.
    """
    states = states_of(results)
    if len(states) > 1:
        each = "; ".join(f"{code}: {', '.join(names)}" for code, names in states.items())
        raise ConfigurationError(
            f"experiments of {len(states)} states of the code ({each}); repeat them with one, in a new "
            "folder, or give --beside to put them beside those of other states, which the page then tells"
        )


def beside(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results with the experiments of `new` in the places of those of `old`."""
    parts = {part: {**old[part], **new[part]} for part in ("experiments", "runs")}
    missing = [name for name in old["missing"] if name not in new["experiments"]]
    return {**old, **parts, "missing": missing}


def table_of_states(results: Mapping[str, Any]) -> str:
    """Return a table in Markdown: the states, the days of their last experiments, and which these are."""
    rows = [
        (code, max(_days(results["runs"][name]) for name in names), ", ".join(f"`{one}`" for one in names))
        for code, names in states_of(results).items()
    ]
    return plain_table(COLUMNS, rows)


def _days(stages: Mapping[str, Any]) -> str:
    return max(made["finished"][:10] for made in stages.values())
