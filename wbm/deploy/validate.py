"""A small validator for the part of JSON Schema (2020-12) that the contract uses, so that the runtime needs no package.

Keywords: `type`, `const`, `enum`, `properties`, `required`, `additionalProperties` (bool or schema), `items`,
`minItems`, `maxItems`, `minLength`, `minimum`, `maximum`, `exclusiveMinimum`. An unknown keyword is an error.
"""

from __future__ import annotations

import math
from typing import Any

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "null": (type(None),),
}
_KEYWORDS = {
    "type", "const", "enum", "properties", "required", "additionalProperties", "items", "minItems", "maxItems",
    "minLength", "minimum", "maximum", "exclusiveMinimum", "description", "title", "$schema",
}  # fmt: skip


def validate(data: Any, schema: dict[str, Any], where: str = "contract") -> None:
    """Check `data` against `schema`.

    Args:
        data: what `json.loads` returned.
        schema: a JSON schema made of the keywords above.
        where: path that leads the messages.

    Raises:
        ValueError: names the first place that does not fit, or a keyword that this validator does not know.
    """
    unknown = set(schema) - _KEYWORDS
    if unknown:
        raise ValueError(f"{where}: schema keywords {sorted(unknown)} are not supported")
    if "type" in schema:
        _check_type(data, schema["type"], where)
    if "const" in schema and data != schema["const"]:
        raise ValueError(f"{where} is {data!r}, expected {schema['const']!r}")
    if "enum" in schema and data not in schema["enum"]:
        raise ValueError(f"{where} is {data!r}, expected one of {schema['enum']}")
    if isinstance(data, dict):
        _check_object(data, schema, where)
    elif isinstance(data, list):
        _check_array(data, schema, where)
    elif isinstance(data, str):
        if len(data) < schema.get("minLength", 0):
            raise ValueError(f"{where} is shorter than {schema['minLength']} characters")
    elif isinstance(data, (int, float)) and not isinstance(data, bool):
        _check_number(data, schema, where)


def _check_type(data: Any, expected: str | list[str], where: str) -> None:
    names = [expected] if isinstance(expected, str) else expected
    for name in names:
        # JSON's true is no number, though Python's bool is an int.
        if isinstance(data, _TYPES[name]) and (name == "boolean" or not isinstance(data, bool)):
            return
    raise ValueError(f"{where} is {type(data).__name__}, expected {' or '.join(names)}")


def _check_object(data: dict[str, Any], schema: dict[str, Any], where: str) -> None:
    properties = schema.get("properties", {})
    for key in schema.get("required", ()):
        if key not in data:
            raise ValueError(f"{where}.{key} is missing")
    extra = schema.get("additionalProperties", True)
    for key, value in data.items():
        if key in properties:
            validate(value, properties[key], f"{where}.{key}")
        elif extra is False:
            raise ValueError(f"{where}.{key} is not a known key")
        elif isinstance(extra, dict):
            validate(value, extra, f"{where}.{key}")


def _check_array(data: list[Any], schema: dict[str, Any], where: str) -> None:
    if not schema.get("minItems", 0) <= len(data) <= schema.get("maxItems", len(data)):
        raise ValueError(
            f"{where} has {len(data)} items, expected {schema.get('minItems', 0)} to {schema.get('maxItems', 'any')}"
        )
    if "items" in schema:
        for i, item in enumerate(data):
            validate(item, schema["items"], f"{where}[{i}]")


def _check_number(data: float, schema: dict[str, Any], where: str) -> None:
    if not math.isfinite(data):
        raise ValueError(f"{where} is {data}, expected a finite number")
    if data < schema.get("minimum", -math.inf) or data > schema.get("maximum", math.inf):
        raise ValueError(f"{where} is {data}, outside {schema.get('minimum')} to {schema.get('maximum')}")
    if "exclusiveMinimum" in schema and data <= schema["exclusiveMinimum"]:
        raise ValueError(f"{where} is {data}, must be greater than {schema['exclusiveMinimum']}")
