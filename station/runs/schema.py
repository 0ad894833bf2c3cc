"""The protobuf messages of the log, built at run time from the table of columns; no generated code.

A row is one ``station.Sample`` on the topic ``/sample``; what is known about the run is a ``station.Metadata``
on ``/metadata``.  Both descriptors stand in every file, so that other programs can decode it.
"""

from __future__ import annotations

from collections.abc import Sequence

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

from station.runs.columns import BY_NAME, LOG_COLUMNS, name_fault

SAMPLE, METADATA = "station.Sample", "station.Metadata"
METADATA_RECORD = "station"  # the MCAP metadata record that holds the same JSON
FIRST_EXTRA_FIELD = 101
_DOUBLE = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
_INT64 = descriptor_pb2.FieldDescriptorProto.TYPE_INT64
_STRING = descriptor_pb2.FieldDescriptorProto.TYPE_STRING


def sample_schema(columns: Sequence[str]) -> bytes:
    """The descriptor set of ``station.Sample`` with the given columns, serialised.

    A column of every run has its place in LOG_COLUMNS as field number; extra columns follow from 101.
    """
    return _schema(SAMPLE, [(name, number, _INT64 if integer else _DOUBLE)
                            for name, number, integer in sample_fields(columns)])


def sample_fields(columns: Sequence[str]) -> list[tuple[str, int, bool]]:
    """Name, field number and whether it is an integer, of each column."""
    fields = []
    extra = FIRST_EXTRA_FIELD
    for name in columns:
        if name in BY_NAME:
            number = LOG_COLUMNS.index(name) + 1
        else:
            number, extra = extra, extra + 1
        fields.append((name, number, name in BY_NAME and BY_NAME[name].integer))
    return fields


def metadata_schema() -> bytes:
    """The descriptor set of ``station.Metadata``: one string of JSON."""
    return _schema(METADATA, [("json", 1, _STRING)])


def _schema(full_name: str, fields: Sequence[tuple[str, int, int]]) -> bytes:
    package, name = full_name.split(".")
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}/{name.lower()}.proto", package=package,
                                              syntax="proto3")
    message = file.message_type.add(name=name)
    for field, number, kind in fields:
        message.field.add(name=field, json_name=field, number=number, type=kind,  # columns x and x_ are two
                          label=descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL)
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def message_class(full_name: str, schema: bytes) -> type[Message]:
    """The message class that a serialised descriptor set describes; ValueError where it describes none."""
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(schema)
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))
    except (DecodeError, TypeError, KeyError, ValueError) as error:
        raise ValueError(f"no usable description of {full_name} ({type(error).__name__})") from None


def sample_columns(sample: type[Message]) -> list[str]:
    """The column names of a file's ``station.Sample``; ValueError where they are not those of a run."""
    fields = sample.DESCRIPTOR.fields
    for field in fields:
        if field.type not in (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_INT64) or field.is_repeated:
            raise ValueError(f"the field {field.name[:40]!r} of {SAMPLE} is not a double or int64")
    names = [field.name for field in fields]
    fault = name_fault(names)
    if fault:
        raise ValueError(fault)
    return names
