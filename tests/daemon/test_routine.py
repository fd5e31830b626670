"""The states of a run, and the ways between them."""

import itertools

import pytest

from polecal.daemon.routine import ENDED, Routine, RoutineError, State

USUAL = [State.CONNECTING, State.ALIGNING, State.COLLECTING, State.CALIBRATING]


@pytest.fixture
def told():
    return []


@pytest.fixture
def routine(told):
    return Routine(lambda *said: told.append(said))


@pytest.mark.parametrize("end", [State.ACCEPTED, State.REJECTED])
def test_a_run_goes_from_idle_to_its_verdict_and_each_step_is_told_with_its_reason(routine, told, end):
    assert routine.state is State.IDLE
    assert not routine.running
    for number, state in enumerate([*USUAL, end]):
        routine.to(state, 100 + number, f"because of {number}")
        assert routine.state is state
        assert routine.since_ns == 100 + number
        assert routine.running == (state is not end)
    before = [State.IDLE, *USUAL]
    assert told == [
        (100 + number, before[number], state, f"because of {number}")
        for number, state in enumerate([*USUAL, end])
    ]


def test_a_lost_solution_leads_back_to_aligning(routine):
    for state in (State.CONNECTING, State.ALIGNING, State.COLLECTING, State.ALIGNING, State.COLLECTING):
        routine.to(state, 0, "")
    assert routine.running


@pytest.mark.parametrize("state", [State.CONNECTING, State.ALIGNING, State.COLLECTING])
def test_what_there_is_can_be_calibrated_from_wherever_a_run_is(routine, state):
    for step in USUAL[: USUAL.index(state) + 1]:
        routine.to(step, 0, "")
    routine.to(State.CALIBRATING, 0, "asked to stop")
    assert routine.state is State.CALIBRATING


def test_the_state_it_is_in_already_is_no_transition(routine, told):
    routine.to(State.CONNECTING, 1, "first")
    routine.to(State.CONNECTING, 2, "again")
    assert len(told) == 1
    assert routine.since_ns == 1


def reach(routine, state):
    ways = {
        State.IDLE: [],
        State.FAULT: [State.FAULT],
        State.ACCEPTED: [*USUAL, State.ACCEPTED],
        State.REJECTED: [*USUAL, State.REJECTED],
    }
    for step in ways.get(state, USUAL[: USUAL.index(state) + 1] if state in USUAL else []):
        routine.to(step, 0, "")


@pytest.mark.parametrize("state", list(State))
@pytest.mark.parametrize("end", [State.IDLE, State.FAULT])
def test_it_can_be_stopped_and_can_fail_anywhere(routine, state, end):
    reach(routine, state)
    routine.to(end, 5, "so")
    assert routine.state is end
    assert not routine.running


@pytest.mark.parametrize("state", sorted(ENDED))
def test_a_new_run_begins_after_every_end(routine, state):
    reach(routine, state)
    routine.to(State.CONNECTING, 5, "asked to start")
    assert routine.running


def test_no_run_is_called_good_or_bad_without_having_been_calibrated(told):
    for state, verdict in itertools.product(State, (State.ACCEPTED, State.REJECTED)):
        routine = Routine()
        reach(routine, state)
        if state in (State.CALIBRATING, verdict):
            continue
        with pytest.raises(RoutineError, match=f"no way from {state} to {verdict}"):
            routine.to(verdict, 0, "")
        assert routine.state is state


@pytest.mark.parametrize("state", [State.ALIGNING, State.COLLECTING, State.CALIBRATING])
def test_an_idle_routine_does_not_skip_steps(routine, told, state):
    with pytest.raises(RoutineError):
        routine.to(state, 0, "")
    assert not told
