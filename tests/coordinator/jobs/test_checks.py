"""Who is wrong when hosts differ: one difference alone accuses nobody."""

import pytest

from dreamfleet.coordinator.jobs.checks import Answer, Check, Decision, decide


def wrong(hosts):
    return Decision(frozenset(hosts))


def held(hosts):
    return Decision(held=frozenset(hosts))


def again(hosts):
    return Decision(ask_again=frozenset(hosts))


OTHER = Decision(ask_other=True)
STEADY = "x1 y2 x1 y2"


@pytest.mark.parametrize(
    ("given", "more", "decision"),
    [
        ("x1 y1", {"others": True}, Decision()),
        # Two that differ are judged by a third, and three by a fourth.
        ("x1 y2", {"others": True}, OTHER),
        ("x1 y2 z1", {}, wrong("y")),
        ("x1 y2 z2", {}, wrong("x")),
        ("x1 y2 z3", {"others": True}, OTHER),
        ("x1 y2 z3 w3", {}, wrong("xy")),
        # Two against two decide nothing.
        ("x1 y2 z1 w2", {"others": True}, OTHER),
        ("x1 y2 z1 w2", {"present": ""}, held("wxyz")),
        # Without a third host both answer once more.
        ("x1 y2", {"present": "xy"}, again("xy")),
        ("x1 y2 x1", {"present": "xy"}, again("y")),
        # A host that comes round to the other's word was wrong before, a trusted host too.
        ("x1 y2 y1", {}, wrong("y")),
        ("x1 y2 x2", {"trusted": "x"}, wrong("x")),
        # A host that contradicts itself is wrong if the other does not; if both do, nobody is.
        ("x1 y2 x1 y3", {}, wrong("y")),
        ("x1 y2 x3 y4", {}, Decision()),
        # Two that stay with their words wait for a third.
        (STEADY, {}, held("xy")),
        (STEADY, {"trusted": "xy"}, held("xy")),
        (STEADY, {"others": True}, OTHER),
        # A trusted host is believed against one host and not against two.
        (STEADY, {"trusted": "x"}, Decision(frozenset("y"), by_trusted=True)),
        ("x1 y2 z2", {"trusted": "x"}, wrong("x")),
    ],
)
def test_what_the_answers_of_hosts_prove(given, more, decision):
    """Each answer is a host and its fitness; by default x, y and z could answer again, and nobody else is here."""
    answers = [Answer(host, host, float(value), 10, (), float(n)) for n, (host, value) in enumerate(given.split())]
    found = {"present": "xyz", "others": False, "trusted": ()} | more
    assert decide(answers, set(found["present"]), found["others"], found["trusted"]) == decision


def test_steps_and_measures_must_be_equal_too():
    for other in (Answer("y", "y", 1.0, 11, (2.0,)), Answer("y", "y", 1.0, 10, (3.0,))):
        assert decide([Answer("x", "x", 1.0, 10, (2.0,)), other], {"x", "y"}, True, ()) == OTHER


def test_a_check_goes_to_another_host_of_the_class():
    check = Check("a", {"x"})
    assert check.may_ask("y", "a")
    assert not check.may_ask("x", "a")
    assert not check.may_ask("y", "b")
    assert not Check("", {"x"}).may_ask("y", "")
    assert not Check("non-deterministic", {"x"}).may_ask("y", "non-deterministic")
    assert not Check("a", {"x"}, {"y"}).may_ask("y", "a")
    assert Check("a", {"x", "y"}, only=frozenset("x")).may_ask("x", "a")
