from dreamfleet.worker.service.refusals import FIRST, LONGEST, Refusals


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
