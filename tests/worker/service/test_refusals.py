from dreamfleet.worker.service.refusals import ALONE, FIRST, LONGEST, Refusals


def test_a_run_that_refused_is_asked_again_and_ever_later():
    refusals, now, pauses = Refusals(), 0.0, []
    for _ in range(10):
        pauses.append(refusals.add("night", now))
        assert refusals.standing(now + pauses[-1] - 0.1) == {"night"}
        now += pauses[-1]
        assert refusals.standing(now) == set()
    assert pauses[:3] == [FIRST, 2 * FIRST, 4 * FIRST]
    assert pauses[-1] == LONGEST


def test_each_run_has_its_own_pause():
    refusals = Refusals()
    refusals.add("night", 0.0)
    refusals.add("night", FIRST)
    refusals.add("day", FIRST)
    assert refusals.standing(2 * FIRST - 0.1) == {"night", "day"}
    assert refusals.standing(2 * FIRST + 0.1) == {"night"}


def test_a_reason_is_news_once_and_again_when_another_comes_between():
    refusals = Refusals()
    assert [refusals.is_news("night", why) for why in "aabba"] == [True, False, True, False, True]
    assert refusals.is_news("day", "a")


def test_a_run_that_was_worked_for_begins_with_the_shortest_pause_again():
    refusals = Refusals(*ALONE)
    assert [refusals.add("night", 0.0) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    refusals.forgive("night")
    assert refusals.standing(0.0) == set()
    assert refusals.add("night", 0.0) == 1.0
