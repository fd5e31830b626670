import random

from polecal.drivers.emulated.line import Line, garble

BYTE_NS = 1_041_667  # at 9600


def left(line, t_ns):
    line.run(t_ns)
    return b"".join(data for _, data in line.take())


def test_a_byte_leaves_with_its_last_bit():
    line = Line(9600, 0)
    line.send(1_000_000, b"abc")
    assert left(line, 1_000_000 + BYTE_NS - 10) == b""
    assert left(line, 1_000_000 + BYTE_NS) == b"a"
    assert left(line, 1_000_000 + 2 * BYTE_NS) == b"b"
    assert line.next_ns() == 1_000_000 + 3 * BYTE_NS - 1
    assert left(line, 10**9) == b"c"
    assert line.next_ns() is None


def test_what_was_ready_first_leaves_first():
    line = Line(9600, 0)
    line.send(0, b"ab")
    line.send(0, b"cd")
    assert line.busy_until_ns == 4e10 / 9600
    assert left(line, 3 * BYTE_NS) == b"abc"


def test_the_rate_changes_after_the_last_byte_of_the_answer():
    line = Line(9600, 0)
    line.send(0, b"ok", then_baud=500000)
    line.send(0, b"x")
    line.run(3 * BYTE_NS)
    assert line.take() == [(9600, b"ok"), (500000, b"x")]
    assert line.baud == 500000


def test_a_cut_lets_only_the_byte_on_the_wire_out():
    line = Line(9600, 0)
    line.send(0, b"abcdef")
    line.cut(int(2.5 * BYTE_NS))
    assert left(line, 10**9) == b"abc"


def test_a_cut_before_the_first_bit_lets_nothing_out():
    line = Line(9600, 0)
    line.send(10**9, b"abcdef")
    line.cut(10**8)
    assert left(line, 10**10) == b""


def test_the_right_rate_hears_and_another_hears_noise():
    rng = random.Random(1)
    sent = bytes(range(200))
    assert garble(sent, 38400, 38400, rng) == sent
    slower = garble(sent, 38400, 9600, rng)
    assert len(slower) == 50
    assert slower not in sent
