"""Three ways to damage a valid file: bytes, structure, meaning.

`damaged` draws from a seeded generator alone, so that an input is named by its seed and number.
"""

import json
import random
import struct
from dataclasses import replace
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from jiggle_mj.recording.npz_arrays import read_npz
from jiggle_mj.recording.topics import LEFT
from tests.support.mcap_edits import Records, assembled, records_of
from tests.support.valid_files import Reader, packed

NUMBERS: tuple[Any, ...] = (
    0, 1, -1, 2, 0.5, -1e-3, 1e308, -1e308, 5e-324, 2**31, 2**32, 2**63, -(2**63), 2**64, 10**400,
    float("nan"), float("inf"), -float("inf"), True, None, "", "x", "nan", [], {}, [[]], [1, 2, 3], {"a": 1},
    "y" * 5000,
)  # fmt: skip
"""Values that stand in for a number."""
WORDS = (
    b"nan",
    b"1e999",
    b"-1",
    b"99999999999",
    b",",
    b";",
    b"\t",
    b"\n",
    b'"',
    b"\0",
    b"#",
    b"\xff\xfe",
    b"{",
    b"1,5",
)
"""What damage inserts that means something in a text."""
PROTOBUF = {
    "foxglove.PointCloud": PointCloud,
    "foxglove.PoseInFrame": PoseInFrame,
    "foxglove.CameraCalibration": CameraCalibration,
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.FrameTransforms": FrameTransforms,
}
"""Schemas whose messages get other meanings."""


def damaged(reader: Reader, generator: random.Random) -> tuple[str, bytes]:
    """Return a damaged copy of a reader's file, and the kind of damage."""
    if not reader.is_mcap:
        text_like = reader.path.suffix in (".json", ".toml")
        if text_like and generator.random() < 0.7:
            return "meaning", _other_text(reader.valid, generator)
        if reader.path.suffix == ".npz" and generator.random() < 0.5:
            return "meaning", _other_arrays(reader.valid, generator)
        return "bytes", _other_bytes(reader.valid, generator)
    kind = generator.choice(("bytes", "structure", "meaning", "meaning"))
    if kind == "bytes":
        return kind, _other_bytes(reader.valid, generator)
    records = records_of(reader.valid)
    for _ in range(generator.choice((1, 1, 2, 4))):
        records = (_other_structure if kind == "structure" else _other_meaning)(records, generator)
    return kind, assembled(records, chunked=generator.random() < 0.3)


def _other_bytes(data: bytes, generator: random.Random) -> bytes:
    changed, at = bytearray(data), generator.randrange(len(data))
    match generator.randrange(7):
        case 0:
            for _ in range(generator.choice((1, 1, 2, 8, 64))):
                changed[generator.randrange(len(changed))] ^= 1 << generator.randrange(8)
        case 1:
            del changed[at:]
        case 2:
            del changed[at : at + generator.choice((1, 4, 8, 9, 100, 1000))]
        case 3:
            other = generator.randrange(len(data))
            changed[at:at] = data[other : other + generator.choice((1, 8, 100, 5000))]
        case 4:
            changed[at : at + 8] = struct.pack(
                "<Q", generator.choice((0, 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1))
            )
        case 5:
            changed[at:at] = generator.choice(WORDS)
        case _:
            length = generator.choice((1, 4, 16, 256))
            changed[at : at + length] = generator.randbytes(length)
    return bytes(changed)


def _other_text(data: bytes, generator: random.Random) -> bytes:
    """Return a text with one of its numbers, words or lines replaced, dropped, doubled, or nested too deeply."""
    text = data.decode()
    lines = text.splitlines()
    place = generator.randrange(len(lines))
    match generator.randrange(6):
        case 0 | 1 | 2:
            head, separator, _ = lines[place].partition("=" if "=" in lines[place] else ":")
            value = json.dumps(generator.choice(NUMBERS)) if generator.random() < 0.9 else "1979-05-27T07:32:00Z"
            lines[place] = f"{head}{separator} {value}" + ("," if ":" in separator else "")
        case 3:
            del lines[place]
        case 4:
            lines.insert(generator.randrange(len(lines)), lines[place])
        case _:
            depth = generator.choice((10, 2000, 100_000))
            head, separator, _ = lines[place].partition("=" if "=" in lines[place] else ":")
            lines[place] = f"{head}{separator} " + "[" * depth + "]" * depth
    return "\n".join(lines).encode()


def _other_structure(records: Records, generator: random.Random) -> Records:
    records = list(records)
    if not records:
        return records
    one, other = generator.randrange(len(records)), generator.randrange(len(records))
    match generator.randrange(8):
        case 0:
            del records[one]
        case 1:
            records.insert(other, records[one])
        case 2:
            records[one], records[other] = records[other], records[one]
        case 3:
            generator.shuffle(records)
        case 4:
            records[one] = replace(records[one], number=generator.choice((0, 1, 2, 3, 7, 65535)))
        case 5:
            topics = (
                "/tool/pose",
                "/tool/grasp",
                "/tissue/points",
                "/truth/x",
                "",
                "/tf",
                LEFT,
                "[/b]",
            )
            records[one] = replace(records[one], name=generator.choice((*topics, "x" * 100_000)))
        case 6:
            times = (0, 1, 2**63, 2**64 - 1, records[one].time + 10**9, max(0, records[one].time - 10**9))
            records[one] = replace(records[one], time=generator.choice(times))
        case _:
            data = records[one].data
            records[one] = replace(records[one], data=_other_bytes(data, generator) if data else b"\xff")
    return records


def _other_meaning(records: Records, generator: random.Random) -> Records:
    """Return records with one field of one message, table or array changed to a value that means something else."""
    records = list(records)
    place = generator.randrange(len(records))
    record = records[place]
    if record.kind == "metadata":
        entries = dict(record.entries)
        key = generator.choice(list(entries) or ["x"])
        entries[key] = _other_json(entries.get(key, ""), generator)
        records[place] = replace(record, entries=entries)
    elif record.kind == "attachment":
        records[place] = replace(record, data=_other_arrays(record.data, generator))
    elif record.kind == "message" and record.schema in PROTOBUF:
        message = PROTOBUF[record.schema].FromString(record.data)
        _set_something(message, generator)
        records[place] = replace(record, data=message.SerializeToString())
    elif record.kind == "message":
        records[place] = replace(record, data=_other_json(record.data.decode(errors="replace"), generator).encode())
    return records


def _other_json(text: str, generator: random.Random) -> str:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return str(generator.choice(NUMBERS))
    holders = [value]
    for holder in holders:
        inner = holder.values() if isinstance(holder, dict) else holder if isinstance(holder, list) else ()
        holders += [each for each in inner if isinstance(each, dict | list) and each]
    holder = generator.choice(holders)
    if isinstance(holder, dict | list) and holder:
        key = generator.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        if generator.random() < 0.2:
            del holder[key]
        else:
            holder[key] = generator.choice(NUMBERS)
    else:
        value = generator.choice(NUMBERS)
    return json.dumps(value) if generator.random() < 0.97 else "[" * 100_000


def _other_arrays(data: bytes, generator: random.Random) -> bytes:
    arrays = read_npz(data)
    name = generator.choice(list(arrays) or ["x"])
    array = arrays.get(name, np.zeros(3))
    match generator.randrange(7):
        case 0:
            arrays.pop(name, None)
        case 1:
            arrays[name] = array[..., None] if generator.random() < 0.5 else array.ravel()
        case 2:
            arrays[name] = array[:-1] if array.ndim else np.zeros(2)
        case 3:
            kinds = ("i1", "u8", "f2", "f8", "c16", "S3", "U5", "M8[s]", "?", "V4")
            arrays[name] = np.zeros(array.shape, generator.choice(kinds))
        case 4:
            arrays[name] = np.full(array.shape, generator.choice((np.nan, np.inf, -1.0, 1e308, 2.0**40)))
        case 5:
            arrays[name] = np.full(array.shape, generator.choice((-1, -2, 2**31, 2**62, 10_000)))
        case _:
            arrays["other"] = array
    return packed(arrays)


def _set_something(message: Any, generator: random.Random) -> None:
    """Set one field of a protobuf message, or of one inside it, to another value of its type, or clear it."""
    field = generator.choice(message.DESCRIPTOR.fields)
    value = getattr(message, field.name)
    if generator.random() < 0.1:
        message.ClearField(field.name)
    elif field.message_type is not None:
        if field.is_repeated:
            if len(value) and generator.random() < 0.8:
                _set_something(generator.choice(value), generator)
            else:
                value.add()
        else:
            _set_something(value, generator)
    elif field.is_repeated:
        values = list(value)
        if values and generator.random() < 0.5:
            values[generator.randrange(len(values))] = _other_scalar(field, generator)
        else:
            values = values[:-1] if generator.random() < 0.5 else [*values, _other_scalar(field, generator)]
        message.ClearField(field.name)
        getattr(message, field.name).extend(values)
    else:
        setattr(message, field.name, _other_scalar(field, generator, value))


def _other_scalar(field: Any, generator: random.Random, value: Any = b"") -> Any:
    cpp = field.cpp_type
    if cpp in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
        return generator.choice((0.0, -1.0, 1e308, -1e308, 1e-308, float("nan"), float("inf"), 1e6, 1e9))
    if cpp in (field.CPPTYPE_INT32, field.CPPTYPE_ENUM):
        return (
            generator.choice((0, 1, 7)) if cpp == field.CPPTYPE_ENUM else generator.choice((0, -1, 2**31 - 1, -(2**31)))
        )
    if cpp == field.CPPTYPE_INT64:
        return generator.choice((0, -1, 2**40, 2**62, -(2**62)))
    if cpp in (field.CPPTYPE_UINT32, field.CPPTYPE_UINT64):
        return generator.choice((0, 1, 8, 100, 2**31, 2**32 - 1))
    if cpp == field.CPPTYPE_STRING and field.type != field.TYPE_BYTES:
        return generator.choice(("", "world", "x", "[/b]", "fisheye", "z" * 100_000))
    return _other_bytes(value, generator) if value else b"\0" * generator.choice((1, 24, 1000))
