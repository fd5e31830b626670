"""Lines on which bytes change, are lost, or wait."""


def spoil(trial, state):
    trial.lms.state = trial.span.state = state


def test_where_one_byte_in_a_hundred_is_another_no_wrong_value_comes_through(trial, tell):
    """At 812 bytes a scan there is none that is whole; of 110 bytes a pose, one in three is."""
    trial.in_mid_pass()
    with trial.fault(4.0) as seen:
        spoil(trial, "noisy")
    spoil(trial, "fine")
    trial.recovers()
    trial.goes_on()
    bad = [trial.device(name)["bad_frames"] for name in ("front", "span")]
    assert min(bad) > 20
    assert seen.told("front on", "no whole frame")
    tell(trial.line("1 % of the bytes of both lines wrong for 4 s"))


def test_lines_that_are_both_dead_for_a_while_are_waited_for(trial, tell):
    trial.in_mid_pass()
    with trial.fault(5.0) as seen:
        spoil(trial, "dead")
    spoil(trial, "fine")
    trial.recovers()
    trial.goes_on()
    assert seen.told("front on", "no whole frame")
    assert seen.told("span on", "no whole frame")
    tell(trial.line("both lines dead for 5 s"))


def test_what_both_lines_hold_back_and_then_hand_over_at_once_is_not_misplaced(trial, tell):
    trial.in_mid_pass()
    with trial.fault(0.6):  # as much as fits into what a kernel holds
        spoil(trial, "stuck")
    spoil(trial, "fine")
    trial.recovers()
    trial.goes_on()
    assert [trial.device(name)["reconnects"] for name in ("front", "span")] == [0, 0]
    assert trial.lost_poses() == 0
    tell(trial.line("both lines held back for 0.6 s, nothing lost"))
