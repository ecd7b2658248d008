"""Of coordinators that see each other exactly one continues, whatever tokens of dead ones they see."""

from hypothesis import given
from hypothesis import strategies as st

from dreamfleet.common.protocol.messages import ClaimNote
from dreamfleet.coordinator.service.leader_check import ASK_INTERVAL, LeaderCheck

TIMEOUT = 5.0


def note(nonce, incarnation=1, began=100.0, run_uid="r"):
    return ClaimNote(run_uid=run_uid, incarnation=incarnation, nonce=nonce, began=began)


def rivals(own):
    return LeaderCheck(own.nonce, TIMEOUT, own)


def test_the_own_token_that_returns_after_a_network_cut_is_ignored():
    mine = rivals(note("a"))
    mine.appear("a", 0.0)
    mine.record_note(note("a"))
    assert not mine.has_any
    assert mine.find_stronger(100.0) is None


def test_a_lingering_token_of_a_killed_predecessor_ends_nothing():
    mine = rivals(note("b", incarnation=2))
    mine.appear("a", 0.0)
    assert mine.find_stronger(TIMEOUT - 0.1) is None
    mine.vanish("a")
    mine.record_note(note("a", incarnation=9))  # its answer came after its token went
    assert mine.find_stronger(100.0) is None


def test_a_coordinator_counts_once_it_answers_or_once_its_lease_is_over():
    mine = rivals(note("b"))
    mine.appear("a", 0.0)
    assert mine.due_to_ask(0.0) == ["a"]
    assert mine.due_to_ask(0.1) == []
    assert mine.due_to_ask(ASK_INTERVAL) == ["a"]
    assert mine.find_stronger(TIMEOUT + 0.1) == ("a", None)
    mine.record_note(note("a", began=200.0))
    assert mine.find_stronger(TIMEOUT + 0.1) is None, "it began later, and leaves"
    mine.record_note(note("a", began=50.0))
    assert mine.find_stronger(0.2) is not None
    assert mine.due_to_ask(9.0) == []


NOTES = st.lists(
    st.builds(note, st.sampled_from([f"{n:016x}" for n in range(6)]), st.integers(1, 3), st.sampled_from([1.0, 2.0])),
    min_size=2, max_size=6, unique_by=lambda each: each.nonce,
)  # fmt: skip


@given(NOTES)
def test_exactly_one_of_several_coordinators_continues(notes):
    stay = []
    for own in notes:
        mine = rivals(own)
        for other in notes:
            mine.appear(other.nonce, 0.0)
            mine.record_note(other)
        if mine.find_stronger(0.1) is None:
            stay.append(own)
    assert stay == [min(notes, key=lambda each: (-each.incarnation, each.began, each.nonce))], "the latest incarnation"
