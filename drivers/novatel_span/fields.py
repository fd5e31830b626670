"""A log's declared fields to its binary, ASCII and numpy layouts.

A log is a frozen dataclass whose annotations are the types below, in the order of the wire; that is its
whole description. Binary and ASCII bodies are read by the same declaration.
"""

from __future__ import annotations

import csv
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Annotated, Any, TypeVar, dataclass_transform, get_args, get_type_hints

import numpy as np

from polecal.drivers.novatel_span.enums import NAMELESS, MessageId, named


@dataclass(frozen=True, slots=True)
class Wire:
    """How a field is written: its struct code, and what its numbers mean."""

    code: str
    enum: type[IntEnum] | None = None
    hexadecimal: bool = False


U8 = Annotated[int, Wire("B")]
U16 = Annotated[int, Wire("H")]
U32 = Annotated[int, Wire("I")]
I32 = Annotated[int, Wire("i")]
F32 = Annotated[float, Wire("f")]
F64 = Annotated[float, Wire("d")]
X8 = Annotated[int, Wire("B", hexadecimal=True)]
X32 = Annotated[int, Wire("I", hexadecimal=True)]
Text4 = Annotated[str, Wire("4s")]
Text12 = Annotated[str, Wire("12s")]
Text16 = Annotated[str, Wire("16s")]
Text32 = Annotated[str, Wire("32s")]
Triple32 = Annotated[tuple[float, ...], Wire("3f")]
Matrix33 = Annotated[tuple[float, ...], Wire("9d")]  # row by row

_NUMPY = {"B": "u1", "H": "<u2", "I": "<u4", "i": "<i4", "f": "<f4", "d": "<f8"}
_COUNT = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class _Field:
    """One declared field: its name, and either a `Wire` or the class of the items of a counted list."""

    name: str
    wire: Wire | None
    item: type[Any] | None

    @property
    def values(self) -> int:
        """How many numbers it has on the wire."""
        assert self.wire is not None
        return 1 if self.wire.code.endswith("s") else int(self.wire.code[:-1] or 1)

    def from_raw(self, raw: tuple[Any, ...]) -> Any:
        assert self.wire is not None
        if self.wire.code.endswith("s"):
            return raw[0].partition(b"\0")[0].decode("latin-1")  # as its ASCII twin prints it
        if self.wire.enum:
            return named(self.wire.enum, raw[0])
        return raw[0] if self.values == 1 else raw

    def from_tokens(self, tokens: Iterator[str]) -> Any:
        assert self.wire is not None
        got = tuple(self._number(next(tokens)) for _ in range(self.values))
        return got[0] if self.values == 1 else got

    def _number(self, token: str) -> Any:
        wire = self.wire
        assert wire is not None
        if wire.enum:
            if token.isdecimal():
                return named(wire.enum, int(token))
            return wire.enum.__members__.get(token, NAMELESS)
        kind = wire.code[-1]
        if kind == "s":
            return token
        if kind == "f":  # what the receiver's own 32 bits hold, as its binary log would say it
            return struct.unpack("<f", struct.pack("<f", float(token)))[0]
        return float(token) if kind == "d" else int(token, 16 if wire.hexadecimal else 10)


class Layout:
    """How the bodies of one log class are laid out."""

    def __init__(self, cls: type[Any]) -> None:
        hints = get_type_hints(cls, include_extras=True)
        self.cls = cls
        self.fields = [_field(f.name, hints[f.name]) for f in fields(cls)]
        self.fixed = all(f.wire for f in self.fields)
        """Whether every body has the same length."""
        self._struct = struct.Struct("<" + "".join(f.wire.code for f in self.fields if f.wire))
        self._enums = [(i, f.wire.enum) for i, f in enumerate(self.fields) if f.wire and f.wire.enum]
        self._plain = self.fixed and all(
            f.values == 1 and f.wire and f.wire.code[-1] != "s" for f in self.fields
        )

    @property
    def dtype(self) -> np.dtype[np.void]:
        """A body as a numpy record; only for fixed layouts."""
        return np.dtype([(f.name, *_numpy(f)) for f in self.fields])

    def unpack(self, body: bytes, at: int = 0) -> tuple[Any, int]:
        """Read one object; return it and the offset behind it. Raises struct.error on a short body."""
        if self._plain:
            values = list(self._struct.unpack_from(body, at))
            for i, enum in self._enums:
                values[i] = named(enum, values[i])
            return self.cls(*values), at + self._struct.size
        values = []
        for f in self.fields:
            if f.wire:
                values.append(f.from_raw(struct.unpack_from("<" + f.wire.code, body, at)))
                at += struct.calcsize("<" + f.wire.code)
                continue
            assert f.item is not None
            (count,) = _COUNT.unpack_from(body, at)
            at += _COUNT.size
            if count > len(body):
                raise struct.error(f"{count} items in a body of {len(body)} bytes")
            items = []
            for _ in range(count):
                item, at = layout(f.item).unpack(body, at)
                items.append(item)
            values.append(tuple(items))
        return self.cls(*values), at

    def numbers(self, body: bytes) -> tuple[Any, ...]:
        """Read the bare numbers of a body of a fixed layout. Raises struct.error on a short one."""
        return self._struct.unpack_from(body)

    def scan(self, tokens: Iterator[str]) -> Any:
        """Read one object from ASCII fields. Raises ValueError, StopIteration on a bad line."""
        values = []
        for f in self.fields:
            if f.wire:
                values.append(f.from_tokens(tokens))
                continue
            assert f.item is not None
            values.append(tuple(layout(f.item).scan(tokens) for _ in range(int(next(tokens)))))
        return self.cls(*values)


_LAYOUTS: dict[type[Any], Layout] = {}


def layout(cls: type[Any]) -> Layout:
    """Return the layout of a log class or of an item of its lists."""
    if cls not in _LAYOUTS:
        _LAYOUTS[cls] = Layout(cls)
    return _LAYOUTS[cls]


def ascii_tokens(body: bytes) -> list[str]:
    """Fields of an ASCII body, without their quotes (sheet 1.5)."""
    return next(csv.reader((body.decode("ascii"),)))


def _field(name: str, hint: Any) -> _Field:
    for extra in getattr(hint, "__metadata__", ()):
        if isinstance(extra, Wire):
            return _Field(name, extra, None)
    return _Field(name, None, get_args(hint)[0])


def _numpy(f: _Field) -> tuple[str] | tuple[str, tuple[int]]:
    assert f.wire is not None
    if f.wire.code.endswith("s"):
        return (f"S{f.wire.code[:-1]}",)
    kind = _NUMPY[f.wire.code[-1]]
    return (kind,) if f.values == 1 else (kind, (f.values,))


T = TypeVar("T")
LOGS: dict[int, type[Any]] = {}
"""The log class of each message id."""


@dataclass_transform(frozen_default=True)
def log(*ids: MessageId) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen, slotted log of the messages with those ids; with none, an item of one."""

    def make(cls: type[T]) -> type[T]:
        made = dataclass(frozen=True, slots=True)(cls)
        LOGS.update(dict.fromkeys(ids, made))
        return made

    return make
