from dreamfleet.worker.service.refusal_backoff import FIRST_DELAY, MAX_DELAY, SINGLE_RUN_DELAYS, RefusalBackoff


def test_a_run_that_refused_is_asked_again_with_growing_pauses():
    refusals, now, pauses = RefusalBackoff(), 0.0, []
    for _ in range(10):
        pauses.append(refusals.add("night", now))
        assert refusals.refusing_runs(now + pauses[-1] - 0.1) == {"night"}
        now += pauses[-1]
        assert refusals.refusing_runs(now) == set()
    assert pauses[:3] == [FIRST_DELAY, 2 * FIRST_DELAY, 4 * FIRST_DELAY]
    assert pauses[-1] == MAX_DELAY


def test_each_run_has_its_own_pause():
    refusals = RefusalBackoff()
    refusals.add("night", 0.0)
    refusals.add("night", FIRST_DELAY)
    refusals.add("day", FIRST_DELAY)
    assert refusals.refusing_runs(2 * FIRST_DELAY - 0.1) == {"night", "day"}
    assert refusals.refusing_runs(2 * FIRST_DELAY + 0.1) == {"night"}


def test_a_reason_is_news_once_and_again_after_another_one():
    refusals = RefusalBackoff()
    assert [refusals.is_news("night", why) for why in "aabba"] == [True, False, True, False, True]
    assert refusals.is_news("day", "a")


def test_a_run_that_accepted_the_worker_has_the_shortest_pause_again():
    refusals = RefusalBackoff(*SINGLE_RUN_DELAYS)
    assert [refusals.add("night", 0.0) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    refusals.forget("night")
    assert refusals.refusing_runs(0.0) == set()
    assert refusals.add("night", 0.0) == 1.0
