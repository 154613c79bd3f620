"""`sightfix.models`: the schemas of docs/openapi.json as Python types.

An object becomes a frozen dataclass; one that only requests contain becomes a `TypedDict`, which methods
take as keyword arguments. A trailing underscore separates names from Python's keywords (`class_`, `from_`).
"""

import json
import keyword
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Schema = dict[str, Any]

HEADER = '''# Generated from docs/openapi.json; do not edit.
"""Types of the REST interface."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, NotRequired, TypedDict
'''

JSON_BODIES = ("application/json", "application/merge-patch+json")
SCALARS = {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}


def write_models(openapi: Path, module: Path) -> None:
    """Writes the types of an OpenAPI description as a Python module."""
    document = json.loads(openapi.read_text())
    schemas: dict[str, Schema] = document["components"]["schemas"]
    requests = request_only(document)
    definitions = [
        define(name, schema, is_request=name in requests) for name, schema in in_order_of_definition(schemas)
    ]
    module.write_text("\n\n".join([HEADER, *definitions]))


def request_only(document: Schema) -> set[str]:
    """Names of the schemas that are the JSON body of a request and occur in no response."""
    operations = [
        operation
        for path in document["paths"].values()
        for method, operation in path.items()
        if method in ("get", "put", "post", "patch", "delete")
    ]
    bodies = set()
    for operation in operations:
        for media_type, content in operation.get("requestBody", {}).get("content", {}).items():
            if media_type in JSON_BODIES:
                alternatives = [content["schema"], *content["schema"].get("oneOf", [])]
                bodies |= {reference(schema) for schema in alternatives if "$ref" in schema}
    schemas = document["components"]["schemas"]
    answered: set[str] = set()
    open_names = {name for operation in operations for name in references(operation["responses"])}
    while open_names:
        answered |= open_names
        open_names = {found for name in open_names for found in references(schemas[name])} - answered
    return {name for name in bodies - answered if "properties" in schemas[name]}


def references(node: Any) -> Iterator[str]:
    """Names of all schemas to which a part of the document refers."""
    if isinstance(node, dict):
        if "$ref" in node:
            yield reference(node)
        for value in node.values():
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def reference(schema: Schema) -> str:
    """The name to which a schema refers."""
    return str(schema["$ref"]).rpartition("/")[2]


def in_order_of_definition(schemas: dict[str, Schema]) -> list[tuple[str, Schema]]:
    """The schemas by name; those that extend others after these, aliases and unions last."""

    def order(item: tuple[str, Schema]) -> tuple[bool, int, str]:
        name, schema = item
        is_class = "allOf" in schema or "properties" in schema
        return (not is_class, bases(schema), name)

    def bases(schema: Schema) -> int:
        """How many schemas it extends, one after another."""
        return 1 + bases(schemas[reference(schema["allOf"][0])]) if "allOf" in schema else 0

    return sorted(schemas.items(), key=order)


def define(name: str, schema: Schema, *, is_request: bool) -> str:
    """The definition of a schema."""
    if "allOf" in schema:
        base, own = schema["allOf"]
        return define_dataclass(name, own | {"description": schema.get("description", "")}, reference(base))
    if "properties" in schema:
        return define_typed_dict(name, schema) if is_request else define_dataclass(name, schema)
    inline = [part for part in schema.get("oneOf", []) if "properties" in part]
    classes = [define_dataclass(inline_name(name, part), part) for part in inline]
    members = [
        inline_name(name, part) if "properties" in part else annotation(part) for part in schema.get("oneOf", [schema])
    ]
    alias = f"{name} = {' | '.join(members)}\n"
    return "\n\n".join([*classes, alias + docstring(schema, "")])


def inline_name(name: str, schema: Schema) -> str:
    """A name for an object that is defined within the union `name`: that of the union, and its tag or properties."""
    tags = schema["properties"].get("type", {}).get("enum", [])
    if len(tags) == 1:
        return f"{name}{tags[0]}"
    return name + "".join(part.capitalize() for key in schema["properties"] for part in key.split("_"))


def define_dataclass(name: str, schema: Schema, base: str = "") -> str:
    """A frozen dataclass with keyword arguments."""
    required = set(schema.get("required", []))
    lines = [
        "@dataclass(frozen=True, kw_only=True, slots=True)",
        f"class {name}{f'({base})' if base else ''}:",
    ]
    lines.append(docstring(schema, "    ") or f'    """{name}."""\n')
    for key, value in sorted(schema["properties"].items(), key=lambda item: item[0] not in required):
        kind, default = annotation(value), ""
        if key not in required:
            if kind.startswith(("list[", "dict[")) and "None" not in kind:
                default = f" = field(default_factory={kind.partition('[')[0]})"
            else:
                kind, default = optional(kind), " = None"
        lines.append(f"    {identifier(key)}: {kind}{default}\n{docstring(value, '    ')}")
    return "\n".join(lines)


def define_typed_dict(name: str, schema: Schema) -> str:
    """A `TypedDict`, whose optional keys may be missing."""
    required = set(schema.get("required", []))
    lines = [f"class {name}(TypedDict):", docstring(schema, "    ")]
    for key, value in schema["properties"].items():
        kind = annotation(value)
        kind = kind if key in required else f"NotRequired[{kind}]"
        lines.append(f"    {identifier(key)}: {kind}\n{docstring(value, '    ')}")
    return "\n".join(lines)


def annotation(schema: Schema) -> str:
    """The Python type of a schema."""
    if "$ref" in schema:
        return reference(schema)
    if "oneOf" in schema:
        members = [annotation(part) for part in schema["oneOf"]]
        return " | ".join(sorted(members, key=lambda member: member == "None"))
    if "enum" in schema:
        return f"Literal[{', '.join(map(repr, schema['enum']))}]"
    if "type" not in schema and "properties" not in schema:
        return "Any"
    kinds = schema.get("type", "object")
    if isinstance(kinds, list):
        members = [annotation(schema | {"type": kind}) for kind in kinds]
        return " | ".join(sorted(members, key=lambda member: member == "None"))
    if kinds == "null":
        return "None"
    if kinds == "array":
        return f"list[{annotation(schema['items'])}]"
    if kinds == "object":
        values = schema.get("additionalProperties")
        return f"dict[str, {annotation(values) if isinstance(values, dict) else 'Any'}]"
    if schema.get("format") == "date-time":
        return "datetime"
    return SCALARS[kinds]


def optional(kind: str) -> str:
    """The type, or nothing."""
    return kind if kind.endswith("| None") else f"{kind} | None"


def identifier(key: str) -> str:
    """A JSON key as a Python name."""
    return f"{key}_" if keyword.iskeyword(key) else key


def docstring(schema: Schema, indent: str) -> str:
    """The description as a docstring, or nothing."""
    text = schema.get("description") or next(
        (part["description"] for part in schema.get("oneOf", []) if "description" in part), ""
    )
    if not text:
        return ""
    text = text.replace("\\", "\\\\").replace('"""', "'''")
    return textwrap.indent(f'"""{text}"""', indent) + "\n"
