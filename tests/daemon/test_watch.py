"""What is sent to a terminal draws the status, whatever it showed before, in few bytes."""

import contextlib
import copy
import fcntl
import io
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios

import pytest
import structlog
from rich.color import ColorSystem

from polecal.daemon import screen
from polecal.daemon.control import ControlServer
from polecal.daemon.watch import Painter, Terminal, Watch

LINE_BYTES_S = 960  # of 9600 bit/s

SLICES = [{"slice": k, "pole_returns": 37 * k, "passes": 1, "done": 37 * k >= 100} for k in range(12)]
DEVICE = {"port": "/dev/x", "state": "streaming", "rate_hz": 18.8, "frames": 1520, "bad_frames": 0}
STATUS = {
    "state": "collecting",
    "session": "20261122T031500Z-front",
    "since_s": 81.2,
    "devices": [
        DEVICE | {"name": "front"},
        DEVICE | {"name": "span", "rate_hz": 100.0, "ins_status": "INS_SOLUTION_GOOD"},
    ],
    "lasers": [
        {
            "name": "front",
            "passes": 7,
            "coverage": SLICES,
            "estimate": {"x_m": -0.028, "y_m": -0.361, "z_m": -0.997, "roll_deg": -0.53},
            "cost_m": 0.031,
            "measured_cost_m": 0.118,
            "verdict": {"accepted": False, "reasons": ["slices 2, 3 have no pass"]},
        }
    ],
    "next": "drive past the pole heading 60–150°",
}
OTHERS = [
    {},
    {"state": "idle", "next": "polecal-field start"},
    STATUS | {"state": "fault", "notes": ["all is lost " * 30]},
    STATUS | {"devices": [DEVICE | {"name": "d" * 20, "state": "lost", "problem": "gone " * 40}]},
]


class Vt:
    """A terminal of 24 by 80 that knows no more than to place its cursor, to erase, and to change styles."""

    def __init__(self):
        self.clear()

    def clear(self):
        self.cells = [[(" ", "")] * 80 for _ in range(24)]
        self.row = self.column = 0
        self.style = ""

    @property
    def lines(self):
        return ["".join(char for char, _ in row).rstrip() for row in self.cells]

    def take(self, said):
        for codes, end, char in re.findall(r"\x1b\[([?0-9;]*)([A-Za-z])|([^\x1b])", said):
            match end:
                case "":
                    self.cells[self.row][self.column] = (char, self.style)
                    self.column += 1
                case "H":
                    row, _, column = codes.partition(";")
                    self.row, self.column = int(row or 1) - 1, int(column or 1) - 1
                case "J":
                    self.clear()
                case "K":
                    self.cells[self.row][self.column :] = [(" ", "")] * (80 - self.column)
                case "m":
                    self.style = "" if codes in ("", "0") else self.style + codes
                case other:
                    assert codes.startswith("?"), other


def later(seconds):
    """The status some seconds on, with nothing new but time and frames."""
    made = copy.deepcopy(STATUS)
    made["since_s"] += seconds
    made["devices"][0]["frames"] += round(18.8 * seconds)
    made["devices"][1]["frames"] += 100 * seconds
    made["devices"][0]["rate_hz"] = 18.8 - 0.1 * (seconds % 2)
    return made


@pytest.mark.parametrize("colours", [None, ColorSystem.STANDARD])
def test_each_status_is_what_is_on_the_screen_after_it(colours):
    painter, vt = Painter(Terminal(True, colours)), Vt()
    for status in [*OTHERS, STATUS, *OTHERS[::-1], STATUS, later(1), later(9), STATUS]:
        vt.take(painter.paint(status))
        fresh = Vt()
        fresh.take(Painter(Terminal(True, colours)).paint(status))
        assert vt.cells == fresh.cells
        assert [line for line in vt.lines if line] == [
            line.plain for line in screen.lines(status) if line.plain
        ]


def test_an_update_is_a_small_part_of_a_second_at_9600_baud(tell):
    sizes = {}
    for name, terminal in (
        ("vt100", Terminal(True, None, True)),
        ("xterm", Terminal(True, ColorSystem.STANDARD)),
    ):
        painter = Painter(terminal)
        whole = len(painter.paint(STATUS).encode())
        updates = [len(painter.paint(later(n)).encode()) for n in range(1, 60)]
        assert max(updates) < LINE_BYTES_S / 4
        assert whole < 3 * LINE_BYTES_S
        sizes[name] = f"{name} {whole} B at first, then {sum(updates) / len(updates):.0f} B a second"
        painter.paint(later(60))
        assert painter.paint(later(60)) == ""
    tell(f"status --watch: {', '.join(sizes.values())}")


def test_another_size_is_drawn_anew_and_keeps_the_last_line():
    painter, vt = Painter(Terminal(True)), Vt()
    vt.take(painter.paint(STATUS))
    vt.take(painter.paint(STATUS, 60, 12))
    assert max(map(len, vt.lines)) <= 60
    assert len([line for line in vt.lines if line]) <= 11
    assert any("next: drive past" in line for line in vt.lines)
    assert painter.paint(STATUS, 60, 0)  # no terminal, but nothing to fail at either


class Stream(io.StringIO):
    def __init__(self, encoding="utf-8", tty=True):
        super().__init__()
        self._encoding, self._tty = encoding, tty

    @property
    def encoding(self):
        return self._encoding

    def isatty(self):
        return self._tty


@pytest.mark.parametrize(
    ("stream", "environment", "redraws", "colours", "ascii_only"),
    [
        (Stream(), {"TERM": "xterm-256color", "LANG": "en_AU.UTF-8"}, True, True, False),
        (Stream(), {"TERM": "xterm-256color", "LANG": "en_AU.UTF-8", "NO_COLOR": "1"}, True, False, False),
        (Stream(), {"TERM": "xterm", "LANG": "C", "LC_CTYPE": "C.UTF-8"}, True, True, True),
        (Stream(), {"TERM": "xterm", "LC_ALL": "C", "LANG": "en_AU.UTF-8"}, True, True, True),
        (Stream(), {"TERM": "xterm", "LANG": "C.UTF-8", "LC_CTYPE": "C.UTF-8"}, True, True, False),
        (Stream("iso8859-1"), {"TERM": "xterm", "LANG": "de_DE"}, True, True, True),
        (Stream(), {"TERM": "linux", "LANG": "en_AU.UTF-8"}, True, True, True),
        (Stream(), {"TERM": "vt100", "LANG": "en_AU.UTF-8"}, True, False, True),
        (Stream(), {"TERM": "vt220"}, True, False, True),
        (Stream(), {"TERM": "dumb", "LANG": "en_AU.UTF-8"}, False, False, False),
        (Stream(), {}, False, False, True),
        (Stream(tty=False), {"TERM": "xterm", "LANG": "en_AU.UTF-8"}, False, False, False),
        (Stream(tty=False), {"TERM": "xterm", "LANG": "C"}, False, False, True),
        (Stream("ascii", tty=False), {"TERM": "xterm"}, False, False, True),
    ],
)
def test_what_a_terminal_can_show_is_known(stream, environment, redraws, colours, ascii_only):
    terminal = Terminal.of(stream, environment)
    assert (terminal.redraws, terminal.colours is not None, terminal.ascii_only) == (
        redraws,
        colours,
        ascii_only,
    )


def test_a_terminal_is_given_back_also_after_an_error():
    stream = Stream()
    watch = Watch(Terminal(True), stream)
    with pytest.raises(AttributeError), watch:
        watch.show(None)
    said = stream.getvalue()
    assert said.startswith("\x1b[?1049h\x1b[?25l")
    assert said.endswith("\x1b[?25h\x1b[?1049l")


@pytest.mark.parametrize(("term", "redraws"), [("vt100", True), ("xterm-256color", True), ("dumb", False)])
def test_a_real_terminal_shows_the_status_until_ctrl_c(term, redraws, tmp_path):
    """The command itself, on a pseudo-terminal, with a daemon that counts frames."""
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(io.StringIO()))
    asked = []

    class Counting:
        def handle(self, request):
            asked.append(request)
            return {"class": "STATUS"} | later(len(asked))

    master, slave = os.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    environment = os.environ | {"TERM": term, "LANG": "C.UTF-8", "LC_ALL": "C.UTF-8"}
    command = [
        sys.executable,
        "-m",
        "polecal.daemon.field",
        "--socket",
        tmp_path / "sock",
        "status",
        "--watch",
    ]
    said = b""
    with (
        ControlServer(tmp_path / "sock", Counting(), watch_s=0.05),
        subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=environment) as process,
    ):
        os.close(slave)
        while len(asked) < 20:
            assert select.select([master], [], [], 20)[0], said
            said += os.read(master, 65536)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # EIO once it has gone
            while data := os.read(master, 65536):
                said += data
        assert process.wait(20) == 0
    os.close(master)
    structlog.reset_defaults()
    text = said.decode()
    assert ("\x1b[?1049h" in text) == redraws
    if redraws:
        shown, _, left = text.partition("\x1b[?25h\x1b[?1049l")
        vt = Vt()
        vt.take(shown)
        assert any("next: drive past the pole heading" in line for line in vt.lines)
        assert "next: drive past the pole heading" in left  # the last state stays to be read
        assert shown.count("polecal") == 1  # drawn whole only once
    else:
        assert "\x1b" not in text
        assert text.count("next: drive past") > 5
    assert text.isascii() == (term == "vt100")
