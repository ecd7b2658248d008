"""Who scores a round's run, which of its means drive for the next, and a run that nobody scores any longer."""

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.experiments.iteration.phases import other_means
from dreamfleet.experiments.local.local_run import LocalFleet, LocalRun
from tests.support.processes import DEADLINE, free_port


def test_without_an_address_this_host_scores_alone_with_a_slot_a_core():
    crew = LocalFleet.of((), None, (), ())
    assert crew.listen[0].startswith("tcp/127.0.0.1:")
    assert crew.slots > 0
    assert LocalFleet.of((), 3, (), ()).slots == 3


@pytest.mark.parametrize(
    ("listen", "near"),
    [("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"), ("tcp/[::]:7447", "tcp/127.0.0.1:7447"), ("tcp/host:1", "tcp/host:1")],
)
def test_where_workers_come_from_anywhere_this_host_scores_only_if_asked(listen, near):
    assert LocalFleet.of((listen,), None, (), ()).slots == 0
    crew = LocalFleet.of((listen,), 2, (), ())
    assert (crew.listen, crew.local_endpoint, crew.slots) == ((listen,), near, 2)


def test_the_last_mean_and_the_best_evaluated_ones_drive_beside_the_reported_one():
    seen = [
        StoredEvaluation(generation, 4, mean, 1.0) for generation, mean in ((4, 4.0), (9, 5.0), (14, 3.0), (19, 1.0))
    ]
    assert other_means(seen, 9, 2) == [19, 4]
    assert other_means(seen, 19, 2) == [9, 4]
    assert other_means(seen, None, 9) == [19, 9, 4, 14]
    assert other_means(seen, 4, 0) == other_means([], None, 3) == []
    easy = StoredEvaluation(2, 3, 9.0, 1.0, failed=1)
    assert other_means([easy, *seen], 19, 2) == [9, 4], "a mean over the episodes that did not fail flatters"


def test_a_run_whose_workers_all_failed_is_not_waited_for(tmp_path):
    words = ("coordinator", "--run", "alone", "--runs-dir", tmp_path, "--task", "gym:CartPole-v1", "--generations", 1)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with LocalRun("alone", (*words, "--listen", endpoint), tmp_path) as run:
        run.check_workers()
        run.start_worker("fails", ("worker", "--connect", endpoint, "--slots", "none"))
        run.start_worker("lives", ("worker", "--connect", endpoint, "--run", "another"))
        first, second = (each.popen for each in run._workers)
        assert first.wait(DEADLINE)
        run.check_workers()  # the other one may go on
        second.kill()
        with pytest.raises(DreamfleetError, match=r"\b9\b"):
            run.wait(never_stop, run.check_workers)
