from dreamfleet.common.protocol.messages import Result
from dreamfleet.worker.service.outbox import MAX_RESULTS, Outbox


def result(number):
    return Result(number.to_bytes(32, "little"), 1.0, 10, 0.1, None, None)


def test_a_result_leaves_at_once_and_again_until_its_verdict():
    outbox = Outbox(repeat=1.0)
    outbox.add(result(1))
    assert outbox.due(0.0) == [(result(1),)]
    assert outbox.due(0.5) == []
    assert outbox.due(1.0) == [(result(1),)]
    outbox.acknowledge([result(1).digest])
    assert outbox.due(9.0) == []
    assert len(outbox) == 0


def test_repetitions_of_what_nobody_answers_become_rarer():
    outbox = Outbox(repeat=1.0)
    outbox.add(result(1))
    assert sum(len(outbox.due(second / 10)) for second in range(600)) < 12


def test_many_results_are_cut_into_messages():
    outbox = Outbox(repeat=1.0)
    for number in range(MAX_RESULTS + 5):
        outbox.add(result(number))
    assert [len(results) for results in outbox.due(0.0)] == [MAX_RESULTS, 5]


def test_a_new_coordinator_hears_everything_again():
    outbox = Outbox(repeat=100.0)
    outbox.add(result(1))
    outbox.due(0.0)
    outbox.resend_all()
    assert outbox.due(0.1) == [(result(1),)]


def test_verdicts_on_nothing_are_harmless():
    Outbox(repeat=1.0).acknowledge([b"x" * 32])
