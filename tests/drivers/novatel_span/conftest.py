"""Known messages, and a scripted receiver on a pseudo-terminal."""

import json
import os
import re
import select
import struct
import termios
import threading
import time
import tty
import zlib

import pytest

SPEEDS = {
    getattr(termios, f"B{rate}"): rate for rate in (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
}


@pytest.fixture(scope="session")
def vectors(protocol):
    """The sheet's known messages by name, each with its bytes on the line as ``wire``."""
    known = json.loads((protocol / "novatel-vectors.json").read_text())
    for vector in known:
        text = vector.get("ascii", "").encode() + b"\r\n"
        vector["wire"] = bytes.fromhex(vector["hex"]) if "hex" in vector else text
    return {vector["name"]: vector for vector in known}


class Peer:
    """A receiver that does as it is told, with recorded messages, on a pseudo-terminal of its own.

    refuse: logs and commands that it does not know. replies: INTERFACEMODE's last word. binary_only: its
    port is in NOVATELBINARY mode. silent_logs: taken, but never sent.
    """

    def __init__(
        self,
        messages,
        *,
        baud=115200,
        port="COM1",
        refuse=(),
        replies=True,
        binary_only=False,
        mute=False,
        silent_logs=(),
        logs=None,
    ):
        self.messages = messages
        self.baud = baud
        self.port = port
        self.refuse = set(refuse)
        self.replies = replies
        self.binary_only = binary_only
        self.mute = mute
        self.silent_logs = set(silent_logs)
        self.logs = dict(logs or {})  # name: period, s
        self.commands = []
        self.noise_heard = 0
        self.changed = threading.Condition()
        self._due = {}
        self._buffer = b""
        self._stop, self._stopped = os.pipe()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self):
        os.write(self._stopped, b"x")
        self._thread.join()
        for fd in (self._master, self._slave, self._stop, self._stopped):
            os.close(fd)

    def wait_for(self, condition, timeout_s=5.0):
        with self.changed:
            assert self.changed.wait_for(condition, timeout_s), self.commands

    def reset(self, logs=(), baud=9600):
        """What a power cut does: only saved logs, at the factory's or a saved rate, and a prompt."""
        with self.changed:
            self.logs = dict(logs)
            self.baud = baud
            self.commands.clear()
            self._write(f"[{self.port}]".encode())

    def _run(self):
        while True:
            ready, _, _ = select.select([self._master, self._stop], [], [], 0.005)
            if self._stop in ready:
                return
            with self.changed:
                if ready:
                    self._hear(os.read(self._master, 4096))
                self._send_logs()
                self.changed.notify_all()

    def _matched(self):
        return SPEEDS.get(termios.tcgetattr(self._master)[5]) == self.baud

    def _write(self, data):
        if not self._matched():
            data = bytes(byte & 0x91 | 0x80 for byte in data[::2])
        os.write(self._master, data)

    def _send_logs(self):
        now = time.monotonic()
        for name, period in self.logs.items():
            if now >= self._due.get(name, 0) and name not in self.silent_logs:
                self._due[name] = now + period
                self._write(self.messages[name])

    def _hear(self, data):
        if not self._matched():
            self.noise_heard += len(data)
            return
        self._buffer += data
        while self._buffer:
            if self._buffer.startswith(b"\xaa"):
                if len(self._buffer) < 10:
                    return
                size = 28 + struct.unpack_from("<H", self._buffer, 8)[0] + 4
                if len(self._buffer) < size:
                    return
                frame, self._buffer = self._buffer[:size], self._buffer[size:]
                self._binary(frame)
                continue
            end = re.search(rb"[\r\n]|(?=\xaa)", self._buffer)
            if end is None:
                return
            line, self._buffer = self._buffer[: end.start()], self._buffer[end.end() :]
            if line.strip() and not self.binary_only:
                self._text(line.decode("ascii", "replace"))

    def _text(self, line):
        self.commands.append(line)
        answer, after = self._obey(line)
        if self.mute:
            return
        if self.replies:
            self._write(f"\r\n<{answer}\r\n[{self.port}]".encode())
        after()

    def _binary(self, frame):
        assert zlib.crc32(frame, 0xFFFFFFFF) == 0xFFFFFFFF, "a command with a wrong checksum"
        number = struct.unpack_from("<H", frame, 4)[0]
        body = frame[28:-4]
        if number == 1:
            message, _, _, trigger = struct.unpack_from("<HBBI", body, 4)
            names = {37: "VERSIONB", 42: "BESTPOSB", 101: "TIMEB", 508: "INSPVASB", 1465: "INSPVAXB"}
            names |= {320: "INSCOVSB", 423: "BESTGPSPOSB", 1945: "INSCONFIGB"}
            period = f"ONTIME {struct.unpack_from('<d', body, 12)[0]:g}" if trigger == 2 else "ONCE"
            line = f"LOG {names[message]} {period}"
        else:
            line = {38: "UNLOGALL", 1246: "SERIALCONFIG COM1 {1} N 8 1 N OFF"}[number]
            line = line.format(*struct.unpack_from("<7I", body)) if number == 1246 else line
        self.commands.append(f"binary {line}")
        answer, after = self._obey(line)
        if self.mute:
            return
        if self.replies:
            text = b"OK" if answer == "OK" else answer.removeprefix("ERROR:").encode()
            reply = struct.pack("<I", 1 if answer == "OK" else 6) + text
            head = frame[:6] + b"\x80\x20" + struct.pack("<H", len(reply)) + frame[10:28] + reply
            self._write(head + struct.pack("<I", zlib.crc32(head, 0xFFFFFFFF) ^ 0xFFFFFFFF))
        after()

    def _obey(self, line):
        """The answer to a command, and what happens behind it."""
        words = re.split(r"[ ,]+", line)

        def nothing():
            pass

        if words[0] in self.refuse or (words[0] == "LOG" and words[1] in self.refuse):
            return "ERROR:Invalid Message. Field = 2", nothing
        if self.mute:
            return "OK", nothing
        if words[0] == "UNLOGALL":
            self.logs.clear()
        elif words[0] in ("SERIALCONFIG", "COM"):

            def move():
                termios.tcdrain(self._slave)
                self.baud = int(words[2])

            return "OK", move
        elif words[0] == "LOG" and words[2] == "ONCE":
            return "OK", lambda: self._write(self.messages[words[1]])
        elif words[0] == "LOG":
            self.logs[words[1]] = float(words[3])
        else:
            return "ERROR:Invalid Message. Field = 1", nothing
        return "OK", nothing


@pytest.fixture
def make_peer(vectors):
    """Make scripted receivers; all are closed at the end."""
    names = {
        "INSPVASB": "INSPVASB OEM6",
        "INSPVAXB": "INSPVAXB driven",
        "BESTPOSB": "BESTPOSB INS_PPP",
        "TIMEB": "TIMEB OEM7",
        "INSSTDEVSB": "INSSTDEVB",
        "INSCOVSB": "INSCOVB",
        "BESTGPSPOSB": "BESTPOSB INS_PPP",
        "VERSIONB": "VERSIONB (source bit=1)",
        "INSCONFIGB": "INSCONFIGB",
    }
    messages = {log: vectors[name]["wire"] for log, name in names.items()}
    peers = []

    def make(hardware="OEM628-1.00", **options):
        head = messages["VERSIONB"][:-4].replace(b"OEMV3G-4.00-X2T", hardware.encode().ljust(15, b"\0"))
        version = head + struct.pack("<I", zlib.crc32(head, 0xFFFFFFFF) ^ 0xFFFFFFFF)
        peers.append(Peer(messages | {"VERSIONB": version}, **options))
        return peers[-1]

    yield make
    for peer in peers:
        peer.close()
