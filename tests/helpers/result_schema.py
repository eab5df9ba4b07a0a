"""Results against the shipped JSON Schema, which here forbids every key that it does not name."""

import json
from functools import cache
from typing import Any

from irlos_pipe.reference import RESULTS


def schema_problems(content: dict[str, Any]) -> list[str]:
    """Return where a results.json does not keep to the schema."""
    return [f"{error.json_path}: {error.message}" for error in _validator().iter_errors(content)]


@cache
def _validator() -> Any:
    import jsonschema

    return jsonschema.Draft202012Validator(without_unknown_keys(json.loads(RESULTS.read_text())))


def without_unknown_keys(schema: Any) -> Any:
    """Return a schema that forbids keys that it does not name."""
    if isinstance(schema, list):
        return [without_unknown_keys(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    strict = {key: without_unknown_keys(value) for key, value in schema.items()}
    return {"additionalProperties": False} | strict if "properties" in schema else strict
