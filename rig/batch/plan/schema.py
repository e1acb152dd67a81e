"""The JSON schema of the batch file, with the settings of the procedures that are installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rig.batch.plan.procedures import installed, known
from rig.batch.plan.settings import BatchFile
from rig.core.errors import ConfigurationError
from rig.core.settings import OPTION_HINTS, unit_of

TEXT_WITH_UNIT = {"type": "string", "description": "text as on the command line, with its unit"}


def batch_schema(warn: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return the JSON Schema 2020-12 of `BatchFile`; what an experiment may set and vary follows
    from its procedure. A procedure that is broken is left out, and `warn` gets a line that says
    why."""
    schema = BatchFile.model_json_schema()
    definitions: dict[str, Any] = schema["$defs"]
    procedures: list[str] = []
    for name in known():
        try:
            own = installed(name).Settings.model_json_schema()
        except ConfigurationError as error:
            warn(error.one_line())
            continue
        procedures.append(name)
        definitions.update(own.pop("$defs", {}))
        properties = {field: _or_text(field, part) for field, part in own["properties"].items()}
        definitions[f"{name}.settings"] = {
            "type": "object",
            "properties": properties,
            "additionalProperties": False,
        }
        definitions[f"{name}.matrix"] = {
            "type": "object",
            "properties": {
                field: {"type": "array", "items": part, "minItems": 1}
                for field, part in properties.items()
            },
            "additionalProperties": False,
        }
    schema["properties"]["defaults"] = {
        "type": "object",
        "description": "Settings by procedure.",
        "properties": {name: _ref(f"{name}.settings") for name in procedures},
        "additionalProperties": False,
    }
    experiment = definitions["Experiment"]
    experiment["properties"]["procedure"]["enum"] = procedures
    experiment["allOf"] = [
        {
            "if": {"properties": {"procedure": {"const": name}}},
            "then": {
                "properties": {
                    "settings": _ref(f"{name}.settings"),
                    "matrix": _ref(f"{name}.matrix"),
                    "exclude": {"items": _ref(f"{name}.settings")},
                    "include": {"items": _ref(f"{name}.settings")},
                }
            },
        }
        for name in procedures
    ]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _or_text(field: str, part: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a setting as its procedure takes it, or as text with a unit."""
    unit = unit_of(field)
    described = {k: v for k, v in part.items() if k in ("description", "default", "title")}
    bare = {k: v for k, v in part.items() if k not in described and k not in OPTION_HINTS}
    if unit is not None:
        described["description"] = f"{described.get('description', '')} [{unit}]".strip()
    return {**described, "anyOf": [bare, TEXT_WITH_UNIT]}


def _ref(name: str) -> dict[str, str]:
    return {"$ref": f"#/$defs/{name}"}
