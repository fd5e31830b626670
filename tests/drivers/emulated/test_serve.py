"""The devices on real pseudo-terminals, in real time, as a stranger's client meets them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import serial

from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.serve import serve

ACK_TYPE = b"\x06\x02\x80\x14\x00\xbaLMS291;S05;V02.10 \x10"
TYPE = bytes.fromhex("02 00 01 00 3A 1E 12")


@pytest.fixture
def link(parked, tmp_path):
    """A laser being served at this path."""
    path = tmp_path / "lms"
    laser = EmulatedLaser(parked(), t0_ns=time.monotonic_ns() - 2 * 10**9)
    laser.transmit(time.monotonic_ns(), 9600)  # has said that it is there
    stop, ready = threading.Event(), threading.Event()

    def run():
        serve({str(path): laser}, 60.0, stop=stop, ready=lambda _: ready.set(), usb_latency_s=0.001)

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(5.0)
    yield path
    stop.set()
    thread.join(5.0)
    assert not thread.is_alive()
    assert not path.is_symlink()


def test_a_client_is_answered_at_the_right_rate_only(link):
    with serial.Serial(str(link), 9600, timeout=2.0) as port:
        port.write(TYPE)
        assert port.read(len(ACK_TYPE) + 2).startswith(ACK_TYPE)
        port.baudrate = 38400
        port.write(TYPE)
        port.timeout = 0.3
        assert not port.read(64).startswith(b"\x06\x02\x80")
        port.baudrate = 9600
        port.timeout = 2.0
        port.write(TYPE)
        assert port.read(len(ACK_TYPE) + 2).startswith(ACK_TYPE)


def test_a_client_goes_to_500000_and_reads_scans(link):
    with serial.Serial(str(link), 9600, timeout=2.0) as port:
        port.write(bytes.fromhex("02 00 02 00 20 48 58 08"))
        assert port.read(10) == bytes.fromhex("06 02 80 03 00 A0 00 10 16 0A")
        port.baudrate = 500000
        port.write(bytes.fromhex("02 00 02 00 20 24 34 08"))
        assert port.read(10) == bytes.fromhex("06 02 80 03 00 A0 00 10 16 0A")
        scan = port.read(732)
        assert scan[:7] == bytes.fromhex("02 80 D6 02 B0 69 01")
        port.baudrate = 250000  # a rate that has no name in termios
        port.reset_input_buffer()
        assert b"\x02\x80\xd6\x02\xb0" not in port.read(3000)


def test_a_file_in_the_links_place_is_left_alone(parked, tmp_path):
    path = tmp_path / "precious"
    path.write_text("mine")
    laser = EmulatedLaser(parked(), t0_ns=time.monotonic_ns())
    with pytest.raises(FileExistsError):
        serve({str(path): laser}, 1.0)
    assert path.read_text() == "mine"


def test_the_program_says_where_it_serves_and_ends_when_told(tmp_path):
    lms, span = tmp_path / "lms", tmp_path / "span"
    call = f"run_emulate({str(lms)!r}, {str(span)!r}, 3, 60)"
    code = f"from polecal.drivers.emulated.serve import run_emulate; {call}"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as program:
        said = json.loads(program.stdout.readline())
        assert (said["lms"], said["span"], said["seed"]) == (str(lms), str(span), 3)
        assert set(said["mount"]) == {"x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"}
        assert os.readlink(lms).startswith("/dev/pts/")
        with serial.Serial(str(span), 115200, timeout=2.0) as port:
            port.write(b"\r\nUNLOGALL\r\n")
            assert port.read(13) == b"\r\n<OK\r\n[COM1]"
        program.send_signal(signal.SIGTERM)
        assert program.wait(5.0) == 0
    assert not lms.is_symlink()
    assert not span.is_symlink()
