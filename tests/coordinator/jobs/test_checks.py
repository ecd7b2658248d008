"""Who is wrong when hosts differ: one difference alone accuses nobody."""

from dreamfleet.coordinator.jobs.checks import Answer, Check, Decision, decide


def answers(*given):
    return [Answer(host, fitness, 10, (), float(number)) for number, (host, fitness) in enumerate(given)]


def decided(*given, present="xyz", others=False, anchors=()):
    return decide(answers(*given), set(present), others, anchors)


def test_equal_answers_say_nothing_against_anybody():
    assert decided(("x", 1.0), ("y", 1.0), others=True) == Decision()


def test_steps_and_measures_must_be_equal_too():
    assert decide([Answer("x", 1.0, 10), Answer("y", 1.0, 11)], {"x", "y"}, True, ()).ask_other
    assert decide([Answer("x", 1.0, 10, (2.0,)), Answer("y", 1.0, 10, (3.0,))], {"x", "y"}, True, ()).ask_other


def test_two_that_differ_are_judged_by_a_third():
    assert decided(("x", 1.0), ("y", 2.0), others=True) == Decision(ask_other=True)
    assert decided(("x", 1.0), ("y", 2.0), ("z", 1.0)).wrong == {"y"}
    assert decided(("x", 1.0), ("y", 2.0), ("z", 2.0)).wrong == {"x"}


def test_three_that_differ_are_judged_by_a_fourth():
    assert decided(("x", 1.0), ("y", 2.0), ("z", 3.0), others=True) == Decision(ask_other=True)
    assert decided(("x", 1.0), ("y", 2.0), ("z", 3.0), ("w", 3.0)).wrong == {"x", "y"}


def test_two_against_two_decide_nothing():
    given = ("x", 1.0), ("y", 2.0), ("z", 1.0), ("w", 2.0)
    assert decided(*given, others=True).ask_other
    assert decided(*given, present="").held == {"w", "x", "y", "z"}


def test_without_a_third_host_both_answer_once_more():
    assert decided(("x", 1.0), ("y", 2.0), present="xy").ask_again == {"x", "y"}
    assert decided(("x", 1.0), ("y", 2.0), ("x", 1.0), present="xy").ask_again == {"y"}


def test_who_comes_round_to_the_others_word_was_wrong_before():
    assert decided(("x", 1.0), ("y", 2.0), ("y", 1.0)).wrong == {"y"}
    assert decided(("x", 1.0), ("y", 2.0), ("x", 2.0), anchors={"x"}).wrong == {"x"}, "an anchor too"


def test_who_contradicts_itself_is_wrong_if_the_other_does_not():
    assert decided(("x", 1.0), ("y", 2.0), ("x", 1.0), ("y", 3.0)).wrong == {"y"}


def test_where_nobody_repeats_its_own_word_nobody_is_accused():
    assert decided(("x", 1.0), ("y", 2.0), ("x", 3.0), ("y", 4.0)) == Decision()


def test_two_that_stay_with_their_words_wait_for_a_third():
    steady = ("x", 1.0), ("y", 2.0), ("x", 1.0), ("y", 2.0)
    assert decided(*steady).held == {"x", "y"}
    assert decided(*steady, anchors={"x", "y"}).held == {"x", "y"}
    assert decided(*steady, others=True).ask_other, "as soon as one is there"


def test_an_anchor_is_believed_against_one_host_and_not_against_two():
    steady = ("x", 1.0), ("y", 2.0), ("x", 1.0), ("y", 2.0)
    assert decided(*steady, anchors={"x"}) == Decision(frozenset("y"), by_anchor=True)
    assert decided(("x", 1.0), ("y", 2.0), ("z", 2.0), anchors={"x"}).wrong == {"x"}


def test_a_check_goes_to_another_host_of_the_class():
    check = Check("a", {"x"})
    assert check.may_ask("y", "a")
    assert not check.may_ask("x", "a")
    assert not check.may_ask("y", "b")
    assert not Check("", {"x"}).may_ask("y", "")
    assert not Check("non-deterministic", {"x"}).may_ask("y", "non-deterministic")
    assert not Check("a", {"x"}, {"y"}).may_ask("y", "a")
    assert Check("a", {"x", "y"}, only=frozenset("x")).may_ask("x", "a")
