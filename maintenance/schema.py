"""The JSON Schemas of results.json and of what commands print, from the models that these are made of."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from irlos_pipe.product.printed import (
    Comparison,
    PlannedStage,
    Printed,
    RunStatus,
    Score,
    ShownProduct,
    ShownRecordings,
    ShownRun,
    ShownTrend,
    Validation,
    Versions,
)
from irlos_pipe.product.results import ResultsPart, RunResults, fields_of, models_in, told_of
from irlos_pipe.reference import COMMANDS, RESULTS
from irlos_pipe.stages import LIGHT_PATH, STAGES

PRINTED: tuple[type[Printed], ...] = (
    RunStatus, Versions, ShownProduct, ShownRun, ShownRecordings, ShownTrend, Validation, Score, Comparison,
)  # fmt: skip
PLAN = "irlos-run-plan"  # what `irlos run --dry-run` prints
DIALECT = "https://json-schema.org/draft/2020-12/schema"


class _WithNull(GenerateJsonSchema):
    """Every number may be null, which stands for NaN."""

    def float_schema(self, schema: core_schema.FloatSchema) -> JsonSchemaValue:
        return super().float_schema(schema) | {"type": ["number", "null"]}


def results_schema() -> dict[str, Any]:
    """Return the schema of results.json.

    Keys that a run has nothing to say about are left out, so none is required but those that name the file.
    """
    schema = _schema_of(RunResults)
    known: dict[str, Any] = schema.setdefault("$defs", {})
    sections = {}
    for stage in LIGHT_PATH:
        section = _schema_of(STAGES[stage].Results, f"{stage}.")
        known |= {f"{stage}.{name}": part for name, part in section.pop("$defs", {}).items()}
        known[stage] = section
        sections[stage] = {"$ref": f"#/$defs/{stage}"}
    schema["properties"]["stages"] |= {"properties": sections, "additionalProperties": {"type": "object"}}
    schema["required"] = ["schema", "schema_version", "recipe", "status", "stages"]
    return {"$schema": DIALECT} | schema | {"title": "results.json of irlos_pipe"}


def commands_schema() -> dict[str, Any]:
    """Return the schema of what status, show, trend, validate, score and compare print with ``--json``.

    The key ``schema`` of a text says which of them it is; no key is ever left out. A plan is a list.
    """
    known: dict[str, Any] = {}
    for model in PRINTED:
        name = _name_of(model)
        section = _schema_of(model, f"{name}.", required=True)
        known |= {f"{name}.{part}": told for part, told in section.pop("$defs", {}).items()}
        known[name] = section
    stage = _schema_of(PlannedStage, f"{PLAN}.", required=True)
    known[PLAN] = {"type": "array", "items": stage, "title": "Plan"}
    choices = [{"$ref": f"#/$defs/{name}"} for name in (*map(_name_of, PRINTED), PLAN)]
    head = {"$schema": DIALECT, "title": "what commands of irlos_pipe print with --json"}
    return head | {"oneOf": choices, "$defs": known}


def text_of(schema: dict[str, Any]) -> str:
    """Return a `schema` as it lies next to this module, for programs that do not speak Python."""
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


def _name_of(model: type[Printed]) -> str:
    return str(model.model_fields["format"].default)


def _schema_of(model: type[ResultsPart], prefix: str = "", *, required: bool = False) -> dict[str, Any]:
    """The schema of a model; names of its parts begin with a prefix, as stages have parts of one name."""
    template = f"#/$defs/{prefix}{{model}}"
    schema = model.model_json_schema(ref_template=template, schema_generator=_WithNull)
    described = {one.__name__: told_of(one) for one in (model, *_parts(model))}
    for title, section in {schema["title"]: schema, **schema.get("$defs", {})}.items():
        section.pop("description", None)
        if required:
            section["required"] = list(section.get("properties", {}))
        for key, field in section.get("properties", {}).items():
            field.pop("default", None)
            field.pop("title", None)
            field.pop("description", None)
            if key in described.get(title, {}):
                field["description"] = described[title][key]
    return schema


def _parts(model: type) -> Iterator[type]:
    for annotation in fields_of(model).values():
        for inner in models_in(annotation):
            yield inner
            yield from _parts(inner)


if __name__ == "__main__":
    RESULTS.write_text(text_of(results_schema()), encoding="utf-8")
    COMMANDS.write_text(text_of(commands_schema()), encoding="utf-8")
