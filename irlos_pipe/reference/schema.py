"""The JSON Schema of results.json, from the models of the stages' results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from irlos_pipe.product.results import ResultsPart, RunResults
from irlos_pipe.reference.numbers import models_in, told_of
from irlos_pipe.stages import LIGHT_PATH, STAGES

FILE = Path(__file__).with_name("results.schema.json")
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


def schema_text() -> str:
    """Return the schema as it lies beside this module, for programs that do not speak Python."""
    return json.dumps(results_schema(), indent=1, ensure_ascii=False) + "\n"


def _schema_of(model: type[ResultsPart], prefix: str = "") -> dict[str, Any]:
    """The schema of a model; names of its parts begin with a prefix, as stages have parts of one name."""
    template = f"#/$defs/{prefix}{{model}}"
    schema = model.model_json_schema(ref_template=template, schema_generator=_WithNull)
    described = {one.__name__: told_of(one) for one in (model, *_parts(model))}
    for title, section in {schema["title"]: schema, **schema.get("$defs", {})}.items():
        section.pop("description", None)
        for key, field in section.get("properties", {}).items():
            field.pop("default", None)
            field.pop("title", None)
            if key in described.get(title, {}):
                field.setdefault("description", described[title][key])
    return schema


def _parts(model: type[ResultsPart]) -> Iterator[type[ResultsPart]]:
    for field in model.model_fields.values():
        for inner in models_in(field.annotation):
            yield inner
            yield from _parts(inner)


if __name__ == "__main__":
    FILE.write_text(schema_text(), encoding="utf-8")
