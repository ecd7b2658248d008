"""The states of a run: the protocol's reference draws the transitions that exist, and in any order none is wrong."""

import re

from hypothesis import given
from hypothesis import strategies as st

from dreamfleet.common.errors import InternalError
from dreamfleet.common.protocol.stop_kind import PauseKind, StopKind, StopReason
from dreamfleet.coordinator.run.run_state import Ended, Ending, Pause, Paused, Rewound, Running, Stalled
from tests.support.processes import ROOT

LIMIT = StopReason(StopKind.STEPS, "")
PAUSES = [Pause(kind, kind, until_host=kind is PauseKind.NO_ABLE_HOST) for kind in PauseKind]
TRANSITIONS = {
    "pause": lambda state, number: state.pause(PAUSES[number % len(PAUSES)]),
    "resume": lambda state, _: state.resume(),
    "reach_limit": lambda state, _: state.reach_limit(LIMIT),
    "end": lambda state, _: state.end(),
    "rewind": lambda state, _: state.rewind(),
    "stall": lambda state, number: state.stall("", float(number)),
    "recover": lambda state, _: state.recover(),
}
SETTLED = [
    Running(), Ending(LIMIT), Paused((PAUSES[0],), Running()), Paused((PAUSES[0],), Ending(LIMIT)), Ended(LIMIT),
    Rewound(),
]  # fmt: skip
ARROW = re.compile(r"^ +(\w+) --> (\w+): (.*) \(([\w, ]+)\)$", re.MULTILINE)


def follow(state, name, number=0):
    """The next state; `None` if there is none."""
    try:
        return TRANSITIONS[name](state, number)
    except InternalError:
        return None


def test_the_reference_draws_each_transition_and_no_other():
    page = (ROOT / "docs/reference/protocol.md").read_text()
    section = page.partition("### States of a run\n")[2].partition("\n#")[0]
    drawn = {(before, each, after) for before, after, _, names in ARROW.findall(section) for each in names.split(", ")}
    states = [*SETTLED, *(each.stall("", 0.0) for each in SETTLED)]
    arrows = {(type(each).__name__, name, type(then).__name__)
              for each in states for name in TRANSITIONS if (then := follow(each, name)) is not None}  # fmt: skip
    assert arrows == drawn


@given(st.lists(st.tuples(st.sampled_from(sorted(TRANSITIONS)), st.integers(0, 99))))
def test_in_any_order_a_stall_changes_no_course_and_a_reached_limit_is_kept(moves):
    state = course = Running()  # `course` is of the same moves without stalls
    for name, number in moves:
        if (then := follow(state, name, number)) is None:
            continue
        if name not in ("stall", "recover"):
            course = TRANSITIONS[name](course, number)
            assert course.is_over or course.reached == (state.reached or then.reached)
        state = then
        assert state.settled == course
        assert not isinstance(state.settled, Stalled)
        assert state.gives_jobs == (not (state.is_over or state.paused or state.stalled))
        assert bool(state.ended) + state.is_rewound == state.is_over
        if state.paused is not None:
            kinds = [each.kind for each in state.paused.pauses]
            assert len(kinds) == len(set(kinds))
            assert not state.is_over


@given(st.permutations(PAUSES))
def test_resume_ends_all_pauses_and_only_the_latest_waits_for_a_host(pauses):
    for state in (Running(), Ending(LIMIT)):
        paused = state
        for each in pauses:
            paused = paused.pause(each)
            assert paused.pause(each) == paused
            assert paused.paused.until_host == each.until_host
        assert paused.pauses == tuple(reversed(pauses))
        assert paused.resume() == state
