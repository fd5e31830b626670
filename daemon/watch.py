"""Drawn lines to the few bytes that bring a terminal up to date, also over a serial line at 9600 bit/s.

Nothing but what every terminal since the VT100 understands is needed: a cursor that can be placed, and a
line that can be erased to its end (ECMA-48); what a terminal lacks beside that, it ignores.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TextIO

from rich.color import ColorSystem
from rich.console import Console
from rich.style import Style
from rich.text import Text

from polecal.daemon import screen

_NO_CURSOR = ("", "dumb", "unknown")
_FEW_GLYPHS = ("linux", "vt", "ansi", "cons")
"""What terminals' names begin with whose font may have little but ASCII, whatever the locale says."""
_NO_COLOURS = ("vt",)
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
_CLEAR, _ERASE, _PLAIN = "\x1b[H\x1b[2J", "\x1b[K", "\x1b[0m"
_JUMP_CELLS = 7  # that are alike: shorter to write again than to move the cursor past

Cell = tuple[str, str]
"""A character, and the codes that switch to its style."""


@dataclass(frozen=True, slots=True)
class Terminal:
    """What a stream's end can show."""

    redraws: bool = False
    colours: ColorSystem | None = None
    ascii_only: bool = False

    @classmethod
    def of(cls, stream: TextIO, environment: Mapping[str, str] = os.environ) -> Self:
        """Tell it from the stream's encoding, TERM and NO_COLOR (no-color.org)."""
        name = environment.get("TERM", "")
        redraws = stream.isatty() and name not in _NO_CURSOR
        colours = redraws and not environment.get("NO_COLOR") and not name.startswith(_NO_COLOURS)
        plain = not stream.encoding.lower().startswith("utf") or _plain_locale(environment, stream.isatty())
        few = stream.isatty() and name.startswith(_FEW_GLYPHS)
        return cls(redraws, ColorSystem.STANDARD if colours else None, few or plain)

    def console(self, stream: TextIO) -> Console:
        """Make what prints on such a terminal."""
        return Console(file=stream, no_color=self.colours is None, highlight=False)


def _plain_locale(environment: Mapping[str, str], is_terminal: bool) -> bool:
    """Say whether the locale is C, in which Python itself writes UTF-8 and says so in LC_CTYPE (PEP 538)."""
    kind = environment.get("LC_CTYPE", "")
    own = kind if kind != "C.UTF-8" else ""
    told = environment.get("LC_ALL") or own or environment.get("LANG", "")
    return told in ("C", "POSIX") or (not told and is_terminal)


class Painter:
    """Draws over what it drew before, as far as that has changed."""

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self._console = Console(force_terminal=True, color_system=None)
        self._size = (0, 0)
        self._shown: list[list[Cell]] = []

    def paint(self, status: Mapping[str, Any], columns: int = 80, rows: int = 24) -> str:
        """Give what turns the terminal, of this size by now, into a status."""
        out = ""
        if (columns, rows) != self._size:
            self._size, self._shown, out = (columns, rows), [], _CLEAR
        lines = screen.lines(status, min(columns, screen.WIDTH), ascii_only=self._terminal.ascii_only)
        if len(lines) >= rows:  # what to drive next is worth more than what stands above it
            lines = [*lines[: max(0, rows - 2)], lines[-1]]
        return out + self._over(lines)

    def _over(self, lines: Sequence[Text]) -> str:
        wanted = [self._cells(line) for line in lines]
        out = ""
        for row in range(max(len(wanted), len(self._shown))):
            now = wanted[row] if row < len(wanted) else []
            before = self._shown[row] if row < len(self._shown) else []
            for start, end in _changes(before, now):
                out += _place(row, start) + _written(now[start:end])
            if len(before) > len(now):
                out += _place(row, len(now)) + _ERASE
        self._shown = wanted
        return out

    def _cells(self, line: Text) -> list[Cell]:
        return [
            (char, codes)
            for segment in line.render(self._console)
            for codes in (self._codes(segment.style),)
            for char in segment.text
        ]

    def _codes(self, style: Style | None) -> str:
        if style is None:
            return ""
        colours = self._terminal.colours
        if colours is None:
            style, colours = Style(bold=style.bold), ColorSystem.STANDARD
        return style.render("\0", color_system=colours).partition("\0")[0]


def _changes(before: list[Cell], now: list[Cell]) -> Iterator[tuple[int, int]]:
    """Give the stretches of a row that must be written, near ones as one."""
    blank = (" ", "")
    differ = [
        column
        for column, cell in enumerate(now)
        if cell != (before[column] if column < len(before) else blank)
    ]
    while differ:
        start = end = differ[0]
        while differ and differ[0] - end <= _JUMP_CELLS:
            end = differ.pop(0)
        yield start, end + 1


def _place(row: int, column: int) -> str:
    return f"\x1b[{row + 1};{column + 1}H"


def _written(cells: list[Cell]) -> str:
    """Write cells, the codes of a style once for a run of them."""
    out = codes = ""
    for char, wanted in cells:
        if wanted != codes:
            out += (_PLAIN if codes else "") + wanted
            codes = wanted
        out += char
    return out + (_PLAIN if codes else "")


class Watch:
    """A stream's terminal, taken over for as long as it is entered."""

    def __init__(self, terminal: Terminal, stream: TextIO) -> None:
        self._painter, self._stream = Painter(terminal), stream

    def __enter__(self) -> Self:
        self._put(_ENTER)
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # the line may have been hung up
            self._put(_place(screen.HEIGHT, 0) + _LEAVE)

    def show(self, status: Mapping[str, Any]) -> None:
        """Bring the terminal up to date."""
        self._put(self._painter.paint(status, *shutil.get_terminal_size()))

    def _put(self, said: str) -> None:
        self._stream.write(said)
        self._stream.flush()
