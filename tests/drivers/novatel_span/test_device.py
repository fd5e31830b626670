"""The conversation with a receiver, on a real pseudo-terminal."""

import contextlib
import threading

import pytest

from polecal.drivers.errors import DeviceError, DeviceNotFound, DeviceProtocolError
from polecal.drivers.novatel_span import MessageId, NovatelSpan


class Span(NovatelSpan):
    """With less patience, as a pseudo-terminal is quick."""

    answer_s = 0.3
    patience_s = 0.6
    quiet_s = 0.05


def span(peer, baud=115200, rate_hz=50.0, tap=lambda *_: None):
    return Span("span", peer.path, baud, tap, rate_hz=rate_hz)


def set_up(device):
    with contextlib.closing(device.open(threading.Event())) as port:
        device._set_up(port)
        return port.baud


@contextlib.contextmanager
def running(device):
    """The device's life in its own thread."""
    port = device.open(stop := threading.Event())
    thread = threading.Thread(target=device.run, args=(port,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_a_receiver_at_another_rate_is_found_and_brought_to_ours(make_peer):
    peer = make_peer(baud=38400)
    device = span(peer)
    assert set_up(device) == 115200
    assert peer.baud == 115200
    assert peer.noise_heard > 0  # the other rates were tried first
    assert device.pose == MessageId.INSPVAS
    assert peer.logs == {"INSPVASB": 0.02, "BESTPOSB": 1.0, "TIMEB": 1.0, "INSPVAXB": 1.0}
    assert device.results == {
        "SERIALCONFIG COM1 115200 N 8 1 N OFF": "OK",
        "LOG INSCONFIGB ONCE": "OK",
        "LOG INSPVASB ONTIME 0.02": "OK",
        "LOG BESTPOSB ONTIME 1": "OK",
        "LOG TIMEB ONTIME 1": "OK",
        "LOG INSPVAXB ONTIME 1": "OK",
    }
    assert device.identity == "NovAtel OEM628-1.00, model L12LRVA, firmware 3.301"
    assert device.reference_point == "the IMU's centre of navigation"


def test_nothing_is_saved_in_the_receiver(make_peer):
    peer = make_peer(baud=9600)
    set_up(span(peer))
    assert not any("SAVE" in command or "FRESET" in command for command in peer.commands)


def test_a_receiver_at_our_rate_is_left_there(make_peer):
    peer = make_peer()
    assert set_up(span(peer)) == 115200
    assert not any(command.startswith(("SERIALCONFIG", "COM")) for command in peer.commands)


def test_where_inspvas_is_refused_inspvax_is_taken(make_peer):
    peer = make_peer(refuse=["INSPVASB"])
    device = span(peer)
    set_up(device)
    assert device.pose == MessageId.INSPVAX
    assert peer.logs["INSPVAXB"] == 0.02
    assert device.results["LOG INSPVASB ONTIME 0.02"] == "ERROR:Invalid Message. Field = 2"


def test_a_receiver_without_any_pose_log_is_an_error_with_its_own_words(make_peer):
    peer = make_peer(refuse=["INSPVASB", "INSPVAXB"])
    with pytest.raises(
        DeviceProtocolError, match=r"INSPVAXB ONTIME 0\.02: ERROR:Invalid Message\. Field = 2"
    ):
        set_up(span(peer))


def test_a_refused_slow_log_does_not_stop_the_poses(make_peer):
    peer = make_peer(refuse=["BESTPOSB", "TIMEB", "INSPVAXB", "INSCOVSB"])
    device = span(peer)
    set_up(device)
    assert device.results["LOG BESTPOSB ONTIME 1"].startswith("ERROR")
    assert set(peer.logs) == {"INSPVASB"}


@pytest.mark.parametrize(
    ("hardware", "refuse", "asked"),
    [
        ("OEM719N-1.00", [], {"BESTPOSB", "INSPVAXB"}),
        ("OEM719N-1.00", ["INSPVAXB"], {"BESTPOSB", "INSSTDEVSB"}),
        ("OEM719N-1.00", ["INSPVAXB", "INSSTDEVSB"], {"BESTPOSB", "INSCOVSB"}),
        ("OEM628-1.00", ["INSPVAXB"], {"BESTPOSB", "INSCOVSB"}),
        ("OEMV3G-4.00-X2T", [], {"BESTPOSB", "INSCOVSB"}),
        ("OEM4g2-3.03-X2T", ["BESTPOSB"], {"BESTGPSPOSB", "INSCOVSB"}),
        ("SPAN-NG", ["BESTPOSB", "INSPVAXB"], {"BESTGPSPOSB", "INSSTDEVSB"}),
    ],
)
def test_logs_are_asked_for_by_what_the_receiver_has_and_the_next_best_where_refused(
    make_peer, hardware, refuse, asked
):
    peer = make_peer(hardware, refuse=refuse)
    device = span(peer)
    set_up(device)
    assert peer.logs.keys() - {"INSPVASB", "TIMEB"} == asked
    lacking = {"OEM4": "INSPVAXB", "OEMV": "INSPVAXB", "OEM6": "INSSTDEVSB"}.get(hardware[:4], "BESTGNSSPOS")
    assert not any(lacking in command for command in peer.commands)


def test_standard_deviations_that_the_line_cannot_carry_are_gone_without(make_peer):
    """INSCOVSB is longer than the INSPVAXB that the arithmetic counts with; 95 % of 9600 is 9120 bit/s."""
    peer = make_peer("OEM628-1.00", baud=9600, refuse=["INSPVAXB"])
    set_up(span(peer, baud=9600, rate_hz=5.0))
    assert set(peer.logs) == {"INSPVASB", "BESTPOSB", "TIMEB"}


def test_a_receiver_that_does_not_tell_its_setup_is_used_all_the_same(make_peer):
    device = span(make_peer(refuse=["INSCONFIGB", "VERSIONB"]))
    set_up(device)
    assert device.identity == "NovAtel receiver"
    assert "does not say" in device.reference_point


def test_an_old_receiver_takes_its_rate_by_com(make_peer):
    peer = make_peer("OEMV3G-4.00-X2T", baud=9600, refuse=["SERIALCONFIG"])
    assert set_up(span(peer)) == 115200
    assert "COM COM1,115200,N,8,1,N,OFF,ON" in peer.commands
    assert not any(command.startswith("SERIALCONFIG") for command in peer.commands)


def test_a_receiver_of_unknown_make_is_told_its_rate_in_either_way(make_peer):
    peer = make_peer("SPAN-NG", baud=9600, refuse=["SERIALCONFIG"])
    assert set_up(span(peer)) == 115200
    assert "COM COM1,115200,N,8,1,N,OFF,ON" in peer.commands


def test_a_receiver_that_refuses_both_stays_at_its_rate(make_peer):
    peer = make_peer(baud=57600, refuse=["SERIALCONFIG", "COM"])
    device = span(peer, rate_hz=20.0)
    assert set_up(device) == 57600
    assert peer.logs["INSPVASB"] == 0.05


def test_logs_that_do_not_fit_the_rate_it_stays_at_are_refused(make_peer):
    peer = make_peer(baud=57600, refuse=["SERIALCONFIG", "COM"])
    with pytest.raises(DeviceError, match="does not fit 57600"):
        set_up(span(peer, rate_hz=100.0))
    assert peer.logs == {}


def test_a_port_without_a_rate_is_taken_as_it_is(make_peer):
    peer = make_peer(baud=9600, port="ICOM1")
    device = span(peer, baud=115200, rate_hz=100.0)
    assert set_up(device) == 9600
    assert peer.logs["INSPVASB"] == 0.01


def test_replies_may_be_switched_off(make_peer):
    peer = make_peer(baud=9600, replies=False)
    device = span(peer)
    assert set_up(device) == 115200
    assert device.results["LOG INSPVASB ONTIME 0.02"] == ""
    assert peer.logs["TIMEB"] == 1.0


@pytest.mark.parametrize("replies", [True, False])
def test_a_port_in_binary_mode_is_spoken_to_in_binary(make_peer, replies):
    peer = make_peer(baud=9600, binary_only=True, replies=replies)
    device = span(peer)
    assert set_up(device) == 115200
    assert peer.logs["INSPVASB"] == 0.02
    assert all(command.startswith("binary") for command in peer.commands)


def test_replies_between_the_logs_of_an_earlier_run_are_heard(make_peer):
    peer = make_peer(logs={"INSPVAXB": 0.01, "BESTPOSB": 0.05})
    device = span(peer)
    set_up(device)
    assert peer.logs == {"INSPVASB": 0.02, "BESTPOSB": 1.0, "TIMEB": 1.0, "INSPVAXB": 1.0}
    assert set(device.results.values()) == {"OK"}


def test_a_port_that_sends_but_takes_no_command_is_named_as_such(make_peer):
    peer = make_peer(mute=True, logs={"INSPVAXB": 0.05})
    with pytest.raises(DeviceProtocolError, match="at 115200 bit/s, but takes no command") as caught:
        set_up(span(peer))
    assert "INTERFACEMODE" in caught.value.hint


def test_a_silent_port_names_the_rates_that_were_tried(make_peer):
    peer = make_peer(mute=True)
    device = span(peer, baud=230400)
    device.answer_s = 0.02
    with pytest.raises(
        DeviceNotFound, match=rf"no NovAtel receiver on {peer.path} .*230400: 0 bytes, 115200"
    ):
        set_up(device)


def test_more_than_the_line_carries_is_refused_with_the_arithmetic(make_peer):
    peer = make_peer()
    with pytest.raises(
        DeviceError,
        match=r"\(104 B x 200 \+ 104 \+ 76 \+ 158 B\) x 10 bits = 211380 bit/s, 183% of the line",
    ):
        set_up(span(peer, rate_hz=200.0))
    assert not any(command.startswith("LOG INS") for command in peer.commands)


def test_a_hundred_poses_a_second_fit_115200(make_peer):
    peer = make_peer()
    set_up(span(peer, rate_hz=100.0))
    assert peer.logs["INSPVASB"] == 0.01


def test_the_longer_log_is_checked_too(make_peer):
    peer = make_peer(refuse=["INSPVASB"])
    with pytest.raises(DeviceError, match="INSPVAXB at 100 Hz does not fit 115200"):
        set_up(span(peer, rate_hz=100.0))


def test_a_rate_that_no_receiver_logs_at_is_refused(make_peer):
    with pytest.raises(DeviceError, match="30 Hz"):
        set_up(span(make_peer(), rate_hz=30.0))


def test_a_log_that_was_granted_but_never_comes_is_an_error(make_peer):
    peer = make_peer(silent_logs=["INSPVASB"])
    with pytest.raises(DeviceProtocolError, match="no INSPVASB came"):
        set_up(span(peer))
    assert peer.logs == {}  # and nothing else goes on for nobody


def test_a_stopped_device_leaves_the_line_silent(make_peer):
    peer = make_peer()
    device = span(peer)
    with running(device):
        peer.wait_for(lambda: "TIMEB" in peer.logs)
    peer.wait_for(lambda: not peer.logs)
    assert peer.commands[-1] == "UNLOGALL THISPORT"
    assert device.state == "closed"


def test_a_receiver_that_restarts_is_set_up_again(make_peer):
    peer = make_peer()
    device = span(peer)
    device.silence_s = 0.3
    with running(device):
        peer.wait_for(lambda: "TIMEB" in peer.logs)
        peer.reset()
        peer.wait_for(lambda: "TIMEB" in peer.logs)
        assert peer.baud == 115200
    assert device.reconnects >= 1


def test_a_receiver_that_restarts_with_saved_logs_is_set_up_again_though_poses_come(make_peer):
    peer = make_peer()
    device = span(peer)
    with running(device):
        peer.wait_for(lambda: "INSPVAXB" in peer.logs)
        peer.wait_for(lambda: device.state == "streaming")
        peer.reset(logs={"INSPVASB": 0.1}, baud=115200)
        peer.wait_for(lambda: peer.logs.get("INSPVASB") == 0.02)
        peer.wait_for(lambda: device.state == "streaming")
    assert device.reconnects == 1


def test_every_byte_of_the_conversation_is_tapped(make_peer):
    peer = make_peer()
    tapped = []
    set_up(span(peer, tap=lambda direction, t_ns, data: tapped.append((direction, data))))
    assert any(direction == "tx" and b"LOG INSPVASB" in data for direction, data in tapped)
    assert b"<OK" in b"".join(data for direction, data in tapped if direction == "rx")
