"""Whatever a host sends, at whatever rate, a device neither breaks nor forgets how to answer."""

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver

WRITES = st.lists(
    st.tuples(
        st.one_of(
            st.binary(max_size=40),
            st.builds(lms.telegram, st.just(0), st.binary(min_size=1, max_size=12)),
            st.sampled_from(
                [b"\xaa\x44\x12\x1c", b"LOG ", b"UNLOG\r", b"COM\r", b"LOG COM1\r\n", b"LOG TIMEB ONTIME x\r"]
            ),
        ),
        st.sampled_from([9600, 38400, 115200, 500000]),
        st.floats(0.0, 0.5),
    ),
    max_size=12,
)
SLOW_FIXTURES = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@SLOW_FIXTURES
@given(writes=WRITES)
def test_the_laser_survives_and_can_be_found_again(parked, host, t0_ns, writes):
    client = host(EmulatedLaser(parked(), t0_ns=t0_ns), 9600)
    for data, baud, wait_s in writes:
        client.baud = baud
        client.ask(data, wait_s)
    client.listen(4.0)
    for client.baud in (9600, 19200, 38400, 500000):
        client.ask(lms.telegram(0, b"\x20\x25"), 1.0)
        if client.ask(lms.telegram(0, b"\x3a"), 1.0).startswith(b"\x06\x02\x80\x14\x00\xba"):
            return
    raise AssertionError("not found at any rate")


@SLOW_FIXTURES
@given(writes=WRITES)
def test_the_receiver_survives_and_answers_at_its_rate(parked, host, t0_ns, writes):
    receiver = EmulatedReceiver(parked(), t0_ns=t0_ns)
    client = host(receiver, 115200)
    for data, baud, wait_s in writes:
        client.baud = baud
        client.ask(data, wait_s)
    client.baud = receiver.baud
    client.ask(bytes(520) + b"\r\n", 10.0)  # whatever frame was begun is over
    client.ask(b"UNLOGALL\r\n", 2.0)
    assert client.ask(b"UNLOGALL\r\n").endswith(b"<OK\r\n[COM1]")
