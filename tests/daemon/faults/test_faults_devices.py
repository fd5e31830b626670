"""Devices that start again, or no longer know where they are."""


def test_a_laser_that_is_power_cycled_in_mid_pass_comes_back_from_9600(trial, tell):
    trial.in_mid_pass()
    with trial.fault(2.0) as seen:
        trial.lms.do(lambda now_ns: trial.bench.laser.power_cycle(now_ns, off_s=2.0))
    assert trial.bench.laser.baud == 9600
    trial.recovers()
    trial.goes_on()
    assert trial.bench.laser._state.power_ons
    assert seen.devices["front"][0] == "streaming"
    assert "connecting" in seen.devices["front"]
    assert trial.device("front")["reconnects"] >= 1
    assert seen.told("front on", "no whole frame") or seen.told("front on", "started anew")
    trial.untouched("span")
    tell(trial.line("laser without power for 2 s, back at 9600"))


def test_a_receiver_that_restarts_is_set_up_again(trial, tell):
    trial.in_mid_pass()
    with trial.fault(1.0) as seen:
        trial.span.do(trial.bench.receiver.restart)
    trial.recovers()
    trial.goes_on()
    assert seen.told("span on") or seen.told("no poses come")
    assert trial.device("span")["reconnects"] >= 1
    trial.untouched("front")
    tell(trial.line("receiver reset, up after 1 s"))


def test_an_inertial_solution_that_is_lost_is_not_used_until_it_is_good_again(trial, tell):
    trial.in_mid_pass()
    with trial.fault(4.0) as seen:
        trial.span.do(lambda now_ns: trial.bench.receiver.lose_solution(now_ns, 4.0))
    assert seen.states == ["collecting", "aligning"]
    trial.recovers()
    trial.goes_on()
    assert seen.told("navigation says INS_SOLUTION_FREE")
    assert trial.device("span")["unused"]["INS_SOLUTION_FREE"] > 350
    told = [event for event in trial.events("state") if event["new"] == "aligning"]
    assert "INS_SOLUTION_FREE" in told[-1]["why"]
    trial.untouched("front")
    trial.untouched("span")
    tell(trial.line("no good inertial solution for 4 s, which drifts by 4 m"))
