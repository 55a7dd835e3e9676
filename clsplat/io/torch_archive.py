"""Numbers and tensors of a file that `torch.save` wrote, without torch and without unpickling.

Since torch 1.6 such a file is a zip: NAME/data.pkl is a pickle (protocol 2), NAME/data/KEY are the
bytes of its tensors. Unpickling runs whatever code a pickle names. Here the few opcodes that torch
needs for containers, numbers, text and tensors are followed by hand, and the names that a pickle
may call are compared with a short list, never looked up: anything else is an InputError.
"""

import io
import math
import pickletools
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import clean, reason
from clsplat.io.regular import open_regular

LARGEST_BYTES = 1 << 24  # of a file: what belongs to a photo takes a few kilobytes
MOST_AXES = 8
REBUILD = ("torch._utils _rebuild_tensor", "torch._utils _rebuild_tensor_v2")
ORDERED = "collections OrderedDict"
STORAGES = {"torch HalfStorage": "<f2", "torch FloatStorage": "<f4", "torch DoubleStorage": "<f8",
            "torch IntStorage": "<i4", "torch LongStorage": "<i8"}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
LITERALS = ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE")
TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
SILENT = ("PROTO", "STOP")


@dataclass(frozen=True)
class _Name:
    """What the pickle would have looked up, as "module name"."""

    text: str


def read_torch(path):
    """What `torch.save` wrote into `path`: dict, list, tuple, str, int, float, bool, None, and
    tensors as arrays float16, float32, float64, int32 or int64. Else InputError."""
    path = Path(path)
    try:
        with open_regular(path) as file:
            content = file.read(LARGEST_BYTES + 1)
        if len(content) > LARGEST_BYTES:
            raise ValueError(f"more than {LARGEST_BYTES >> 20} MB")
        if not zipfile.is_zipfile(io.BytesIO(content)):
            raise ValueError("no zip archive, which torch writes since 1.6")
        return _content(_members(content))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; copy the whole data set") from None
    except Exception as error:  # there is no end to what zipfile and pickletools raise
        raise InputError(f"{path}: not a torch file of tensors and numbers, or damaged "
                         f"({reason(error)}); copy it again") from None


def _members(content):
    """{name below the archive's one folder: bytes}; torch compresses nothing."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("it is compressed")
        if sum(member.file_size for member in members) > len(content):
            raise ValueError(f"its {len(content)} bytes claim to hold more")
        return {member.filename.partition("/")[2]: archive.read(member) for member in members}


def _content(members):
    if members.get("byteorder", b"little") != b"little":
        raise ValueError("its numbers are big-endian")
    if "data.pkl" not in members:
        raise ValueError("it holds no data.pkl")
    return _interpreted(members["data.pkl"], members)


def _interpreted(program, members):
    """The object a pickle describes; ValueError at the first opcode or name that is not known."""
    stack, marks, memo = [], [], {}

    def popped(count):
        if count > len(stack) - (marks[-1] if marks else 0):
            raise ValueError("it takes more than it has put down")
        taken = stack[len(stack) - count:]
        del stack[len(stack) - count:]
        return taken

    def since_mark():
        return popped(len(stack) - marks.pop())

    for opcode, argument, _ in pickletools.genops(program):
        match opcode.name:
            case name if name in LITERALS:
                stack.append(argument)
            case name if name in CONSTANTS:
                stack.append(CONSTANTS[name])
            case name if name in TUPLES:
                stack.append(tuple(popped(TUPLES[name])))
            case "MARK":
                marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "SETITEM":
                _fill(popped(2), stack[-1])
            case "SETITEMS":
                _fill(since_mark(), stack[-1])
            case "APPEND":
                _list(stack[-2]).append(stack.pop())
            case "APPENDS":
                items = since_mark()
                _list(stack[-1]).extend(items)
            case "GLOBAL":
                stack.append(_Name(argument))
            case "BINPERSID":
                stack.append(_storage(popped(1)[0], members))
            case "REDUCE":
                stack.append(_called(*popped(2)))
            case name if name not in SILENT:
                raise ValueError(f"opcode {name} does not belong there")
    (result,) = stack
    return result


def _fill(items, table):
    if not isinstance(table, dict) or not all(isinstance(key, str) for key in items[::2]):
        raise ValueError("something else than text is a key")
    table.update(zip(items[::2], items[1::2], strict=True))


def _list(value):
    if not isinstance(value, list):
        raise ValueError("it adds to what is no list")
    return value


def _storage(words, members):
    """The array that ("storage", class, key, device, number of values) stands for."""
    if not isinstance(words, tuple) or len(words) != 5 or words[0] != "storage":
        raise ValueError("it refers to what is no storage")
    _, kind, key, _, count = words
    if not isinstance(kind, _Name) or kind.text not in STORAGES or not isinstance(key, str):
        raise ValueError("a storage is of an unknown kind")
    values = np.frombuffer(members[f"data/{key}"], STORAGES[kind.text])
    if not isinstance(count, int) or count != len(values):
        raise ValueError(f"storage {clean(key)} has not the bytes that are claimed")
    return values


def _called(function, arguments):
    """What the two calls that torch makes give."""
    text = function.text if isinstance(function, _Name) else "of no name"
    if text == ORDERED and isinstance(arguments, tuple) and not arguments:
        return {}  # of a tensor's hooks
    if text not in REBUILD:
        raise ValueError(f"it would call {clean(text)!r}")
    storage, offset, shape, strides, *_ = arguments
    if not isinstance(storage, np.ndarray) or not all(
            isinstance(numbers, tuple) and len(numbers) <= MOST_AXES for numbers in (shape, strides)
    ) or not all(type(n) is int and 0 <= n <= LARGEST_BYTES for n in (offset, *shape, *strides)):
        raise ValueError("a tensor is made of something else than numbers")
    if math.prod(shape) > len(storage):
        raise ValueError("a tensor is larger than its storage")
    # numpy itself refuses what reaches outside the buffer
    size = storage.itemsize
    return np.ndarray(shape, storage.dtype, storage, offset * size,
                      [stride * size for stride in strides]).copy()
