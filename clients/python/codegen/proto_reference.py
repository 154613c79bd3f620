"""docs/reference/proto.md: the reference of the gRPC interface, from the descriptors of proto/ and their comments.

`python -m codegen.proto_reference` writes it; with `--check` it fails if the file is not current.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
    ServiceDescriptorProto,
)

from codegen.stubs import run_protoc

REPOSITORY = Path(__file__).resolve().parents[3]
PAGE = REPOSITORY / "docs" / "reference" / "proto.md"
INTRODUCTION = """\
# gRPC interface

Generated from [proto/sightfix/v1](../../proto/sightfix/v1) by `python -m codegen.proto_reference` in
`clients/python`; do not edit. The server has reflection and health checks enabled; errors carry
`google.rpc.ErrorInfo`, whose reason is the last part of the problem's `type` in REST, and `google.rpc.BadRequest`
with the fields at fault. Fields marked *optional* tell a missing value from a default one. """

CommentPath = tuple[int, ...]
MESSAGES, ENUMS, SERVICES = 4, 5, 6
"""Field numbers of FileDescriptorProto, which locate comments."""
NESTED_MESSAGES, NESTED_ENUMS = 3, 4
"""Those of DescriptorProto."""
MEMBERS = 2
"""Field number of fields, enum values and methods in their parents."""


def descriptors(proto: Path) -> FileDescriptorSet:
    """The descriptors of all files under a folder, with comments."""
    with tempfile.NamedTemporaryFile() as output:
        run_protoc(proto, "--include_source_info", f"--descriptor_set_out={output.name}")
        return FileDescriptorSet.FromString(Path(output.name).read_bytes())


class FileReference:
    """The reference of one file."""

    def __init__(self, file: FileDescriptorProto) -> None:
        self._file = file
        self._comments = {
            tuple(it.path): " ".join(it.leading_comments.split()) for it in file.source_code_info.location
        }

    def lines(self) -> Iterator[str]:
        """Markdown of services, messages and enums."""
        for index, service in enumerate(self._file.service):
            yield from self._service(service, (SERVICES, index))
        for index, message in enumerate(self._file.message_type):
            yield from self._message(message, (MESSAGES, index), "")
        for index, enum in enumerate(self._file.enum_type):
            yield from self._enum(enum, (ENUMS, index), "")

    def _service(self, service: ServiceDescriptorProto, path: CommentPath) -> Iterator[str]:
        yield from (f"## {service.name}", "", self._comments.get(path, ""), "")
        yield from ("| RPC | request | response | |", "|---|---|---|---|")
        for index, method in enumerate(service.method):
            request = ("stream of " if method.client_streaming else "") + link(method.input_type)
            response = ("stream of " if method.server_streaming else "") + link(method.output_type)
            comment = self._comments.get((*path, MEMBERS, index), "")
            yield f"| `{method.name}` | {request} | {response} | {cell(comment)} |"
        yield ""

    def _message(self, message: DescriptorProto, path: CommentPath, parent: str) -> Iterator[str]:
        if message.options.map_entry:
            return
        name = f"{parent}{message.name}"
        yield from (f"### {name}", "", self._comments.get(path, ""), "")
        if message.field:
            yield from ("| field | type | |", "|---|---|---|")
            for index, field in enumerate(message.field):
                comment = self._comments.get((*path, MEMBERS, index), "")
                yield f"| `{field.name}` = {field.number} | {field_type(field, message)} | {cell(comment)} |"
            yield ""
        for index, nested in enumerate(message.nested_type):
            yield from self._message(nested, (*path, NESTED_MESSAGES, index), f"{name}.")
        for index, enum in enumerate(message.enum_type):
            yield from self._enum(enum, (*path, NESTED_ENUMS, index), f"{name}.")

    def _enum(self, enum: EnumDescriptorProto, path: CommentPath, parent: str) -> Iterator[str]:
        yield from (f"### {parent}{enum.name}", "", self._comments.get(path, ""), "")
        yield from ("| value | |", "|---|---|")
        for index, value in enumerate(enum.value):
            comment = self._comments.get((*path, MEMBERS, index), "")
            yield f"| `{value.name}` = {value.number} | {cell(comment)} |"
        yield ""


def field_type(field: FieldDescriptorProto, message: DescriptorProto) -> str:
    """The type of a field, with its label."""
    entry = next((it for it in message.nested_type if field.type_name.endswith(f".{message.name}.{it.name}")), None)
    if entry is not None and entry.options.map_entry:
        key, value = entry.field
        return f"map of {field_type(key, entry)} to {field_type(value, entry)}"
    kind = link(field.type_name) if field.type_name else FieldDescriptorProto.Type.Name(field.type)[5:].lower()
    if field.label == FieldDescriptorProto.LABEL_REPEATED:
        return f"list of {kind}"
    if field.HasField("oneof_index") and not field.proto3_optional:
        return f"{kind}, one of `{message.oneof_decl[field.oneof_index].name}`"
    return f"{kind}, *optional*" if field.proto3_optional else kind


def link(type_name: str) -> str:
    """A type as a link to its section; as plain text if it is none of this interface."""
    name = type_name.removeprefix(".sightfix.v1.")
    return f"`{name.removeprefix('.')}`" if name == type_name else f"[{name}](#{name.replace('.', '').lower()})"


def cell(text: str) -> str:
    """Text in a table."""
    return text.replace("|", "\\|")


def page(files: FileDescriptorSet) -> str:
    """The page: files with services first."""
    ordered = sorted(files.file, key=lambda file: (not file.service, file.name))
    sections = [line for file in ordered for line in FileReference(file).lines()]
    return INTRODUCTION + "\n" + "\n".join(sections).rstrip() + "\n"


def main() -> None:
    """Writes or checks the page."""
    text = page(descriptors(REPOSITORY / "proto"))
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text)
    elif PAGE.read_text() != text:
        sys.exit("docs/reference/proto.md is not current: run `python -m codegen.proto_reference` in clients/python")
    else:
        print("docs/reference/proto.md is what proto/ says")


if __name__ == "__main__":
    main()
