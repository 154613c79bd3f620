"""Values of `sightfix.models` from and to JSON."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
Decoder = Callable[[Any], Any]


def to_json(value: Any) -> Any:
    """A value of `sightfix.models`, or a container of them, as JSON values. Fields that are None are omitted.

    Raises:
        ValueError: A time has no UTC offset.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {json_key(name): to_json(it) for name, it in pairs if it is not None}
    if isinstance(value, datetime):
        return format_time(value)
    if isinstance(value, Mapping):
        return {key: to_json(it) for key, it in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(it) for it in value]
    # A scalar of numpy.
    return value.item() if hasattr(value, "item") else value


def request_json(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The keyword arguments of a request (a `TypedDict` of `sightfix.models`) as JSON values.

    None stays: it resets a field of a camera.
    """
    return {json_key(name): to_json(value) for name, value in fields.items()}


def json_key(name: str) -> str:
    """The key of a Python name, which has a trailing underscore where it would be a keyword."""
    return name.removesuffix("_")


def dump(value: Any) -> bytes:
    """JSON values as bytes.

    Raises:
        ValueError: A number is NaN or infinite.
    """
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def format_time(time: datetime) -> str:
    """RFC 3339.

    Raises:
        ValueError: The time has no UTC offset.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} needs a UTC offset, such as tzinfo=datetime.UTC")
    return time.isoformat()


def from_json(kind: type[T], value: Any) -> T:
    """Builds a type of `sightfix.models` from JSON values. Unknown keys are ignored."""
    decoded: T = decoder(kind)(value)
    return decoded


def new_decoder(kind: Any) -> Decoder:
    """A function that builds a type from JSON values."""
    if kind is datetime:
        return datetime.fromisoformat
    if dataclasses.is_dataclass(kind):
        return dataclass_decoder(kind)
    arguments = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return union_decoder(arguments)
    if get_origin(kind) is list:
        element = decoder(arguments[0])
        return lambda values: [element(value) for value in values]
    if get_origin(kind) is dict:
        element = decoder(arguments[1])
        return lambda values: {key: element(value) for key, value in values.items()}
    return lambda value: value


decoder: Callable[[Any], Decoder] = cache(new_decoder)
"""The function that builds a type from JSON values."""


def dataclass_decoder(kind: Any) -> Decoder:
    """The decoder of a dataclass."""
    hints = get_type_hints(kind)
    names = [(json_key(it.name), it.name, decoder(hints[it.name])) for it in dataclasses.fields(kind)]
    return lambda value: kind(**{name: decode(value[key]) for key, name, decode in names if key in value})


def tagged_decoder(kinds: list[Any]) -> Decoder:
    """The decoder of objects, each of which has another constant in its field `type`."""
    tags = ((kind, get_type_hints(kind).get("type")) for kind in kinds)
    by_tag = {get_args(tag)[0]: decoder(kind) for kind, tag in tags if tag is not None}
    return lambda value: by_tag[value["type"]](value)


def union_decoder(members: tuple[Any, ...]) -> Decoder:
    """The decoder of an optional value, or of a union of plain values and objects; `type` tells objects apart."""
    objects = [member for member in members if dataclasses.is_dataclass(member)]
    others = [member for member in members if member is not NoneType and member not in objects]
    decode_object = tagged_decoder(objects) if len(objects) > 1 else decoder(objects[0]) if objects else None
    decode_other = decoder(others[0]) if others else None

    def decode(value: Any) -> Any:
        if value is None:
            return None
        chosen = decode_object if isinstance(value, dict) and decode_object else decode_other
        return chosen(value) if chosen else value

    return decode
