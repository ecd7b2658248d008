"""Snapshots of a run and the answers that are cut from them, without a transport.
Tests run_log.py, service.py, snapshot.py and coordinator/jobs/history.py."""

import dataclasses
import json
import socket
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from dreamfleet.common.client.equal_fitness import ENOUGH
from dreamfleet.common.client.status import PARTS, EpisodeProgress, Population, Throughput, WorkerStatus, read_status
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_OPTIONS, Result
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.schema.validation import from_plain, from_plain_lenient
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.dispatch.event_log import EventLog
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.generation import CandidateScores
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.run.run import BY_HAND
from dreamfleet.coordinator.run.run_state import Pause
from dreamfleet.coordinator.service.run_log import RunLog, summary, worker_command
from dreamfleet.coordinator.service.service import next_commit
from dreamfleet.coordinator.service.snapshot import Snapshot
from dreamfleet.coordinator.service.status import encode_part, encode_status
from tests.support.run_bench import A, Bench
from tests.support.samples import CLOSED, STATUS
from tests.support.snapshots import SCORED, answered, score, snapshot_of


@pytest.fixture
def bench(make_bench):
    return make_bench(Bench, SCORED, generations=3)


def test_the_status_holds_every_candidate_of_the_open_and_of_the_last_generation_and_the_reported_controller(bench):
    before = read_status(answered(snapshot_of(bench)))
    assert before.population == Population(0, 0, 4, (0,) * 4, (2,) * 4, (None,) * 4)
    assert before.last_population is None
    score(bench, 3)
    jobs = Counter(job.candidate for job in bench.given)
    now = read_status(answered(snapshot_of(bench))).population.candidates
    assert [each.done for each in now] == [2 - jobs[index] for index in range(4)]
    assert [each.fitness is None for each in now] == [each.done == 0 for each in now]
    assert answered(snapshot_of(bench), "best")["controller"] is None
    score(bench, 5)
    after, best = read_status(answered(snapshot_of(bench))), answered(snapshot_of(bench), "best")["controller"]
    reported = bench.run.background_jobs.report.current.controller()
    assert (best["sha256"], best["total"]) == (reported.sha256, len(reported.parameters))
    assert best["provenance"]["generation"] == 0
    assert after.last_population == Population(0, 0, 4, (2,) * 4, (2,) * 4, (0.25, 1.25, 2.25, 3.25))
    assert (after.population.generation, after.generation.number, after.generations) == (1, 1, 1)
    assert after.last == after.recent[-1]


def test_a_restart_restores_the_last_generations_candidates(bench):
    score(bench, 8)
    before = snapshot_of(bench)
    bench.restart()
    after = snapshot_of(bench)
    assert (after.last, after.status.last) == (before.last, before.status.last)
    assert after.candidate_scores == before.candidate_scores


def rows(count):
    return [dataclasses.replace(CLOSED, number=number, mean=-123.4567890123456 - number) for number in range(count)]


def looks(count):
    return tuple(StoredEvaluation(number, 16, 120.5 + number, 30.25) for number in range(count))


def large(population, workers, generations, text="x"):
    """A snapshot of an unusual run."""
    candidate_scores = CandidateScores(
        generations, [10_000] * population, [10_000] * population, [-123.45678901234567 + i for i in range(population)]
    )
    fleet = tuple(
        dataclasses.replace(STATUS.worker_list[0], worker=f"a-rather-long-host-{i}/0a1b2c3d", fingerprint=text * 200)
        for i in range(workers)
    )
    status = dataclasses.replace(
        STATUS, why=text * 2000, failures=STATUS.failures * 3, worker_list=(), recent=(),
        workers=dataclasses.replace(STATUS.workers, known=workers),
    )  # fmt: skip
    last = dataclasses.replace(candidate_scores, generation=generations - 1)
    event_log = EventLog()
    for number in range(3 * workers):
        event_log.now = number / 10
        event_log.add("accepted", fleet[number % workers].worker)
    closed = History(rows(generations)).view(), looks(generations)
    return Snapshot(status, fleet, *closed, candidate_scores, last, None, event_log.view(), 1e6)


@pytest.mark.parametrize(("population", "workers", "generations"), [(4, 1, 1), (100_000, 2000, 5000)])
@pytest.mark.parametrize("text", ["x", "\N{SNOWMAN}", "\N{ROLLING ON THE FLOOR LAUGHING}"])
def test_no_answer_is_longer_than_a_message_however_large_the_run(population, workers, generations, text):
    snapshot = large(population, workers, generations, text)
    longest = replace(snapshot.status.settings.task, options="x" * MAX_OPTIONS)
    settings = replace(snapshot.status.settings, task=longest)
    snapshot = replace(snapshot, status=replace(snapshot.status, settings=settings))
    for part in PARTS:
        payload = encode_part(snapshot, part, {}.get)
        assert len(payload) <= MAX_MESSAGE, part
    status = read_status(answered(snapshot))
    assert status.population.total == population
    assert status.worker_list
    assert status.recent[-1].number == generations - 1


def collected(snapshot, part, column, **parameters):
    found, offset, total = [], 0, 1
    while offset < total:
        document = answered(snapshot, part, offset=offset, **parameters)
        total = document["total"]
        found += document[column]
        offset += len(document[column])
    return found


def test_the_pages_of_a_snapshot_together_hold_everything():
    snapshot = large(3000, 150, 250)
    assert [each["worker"] for each in collected(snapshot, "workers", "workers")] == [
        each.worker for each in snapshot.workers
    ]
    assert [from_plain(StoredGeneration, each) for each in collected(snapshot, "history", "history")] == rows(250)
    found = collected(snapshot, "evaluations", "evaluations")
    assert tuple(from_plain_lenient(StoredEvaluation, each) for each in found) == looks(250)
    assert [each["error"] for each in found] == [each.error for each in looks(250)]
    for candidate_scores in (snapshot.candidate_scores, snapshot.last):
        asked = {"generation": candidate_scores.generation}
        assert collected(snapshot, "candidates", "fitness", **asked) == candidate_scores.fitness
        assert answered(snapshot, "candidates", **asked)["generation"] == candidate_scores.generation


@pytest.mark.parametrize("damage", ["-1", "x", "1e9", "9" * 40, ""])
def test_malformed_page_parameters_mean_the_first_page(damage):
    snapshot = large(4, 1, 3)
    for part in PARTS:
        assert answered(snapshot, part, offset=damage, limit=damage) == answered(snapshot, part)


class Rows(list):
    """Counts every row that is read."""

    touched = 0

    def __getitem__(self, index):
        found = super().__getitem__(index)
        Rows.touched += len(found) if isinstance(index, slice) else 1
        return found

    def __iter__(self):
        for row in super().__iter__():
            Rows.touched += 1
            yield row


def touched(bench, generations):
    """Rows of the history and of evaluations that a snapshot, an answer and the stop reason read."""
    bench.run.history.__init__(rows(generations))
    evaluations = bench.run.background_jobs.evaluations
    evaluations.__init__(
        dataclasses.replace(STATUS.best, generation=number, mean=float(number % 7)) for number in range(generations)
    )
    for number in range(len(bench.journal.pending_evaluations()), generations):
        bench.journal.schedule_evaluation(Evaluation(number, bytes(4), 16))
    bench.run.history._rows = Rows(bench.run.history._rows)
    evaluations.rows, evaluations._bests = Rows(evaluations.rows), Rows(evaluations._bests)
    bench.run.limits = dataclasses.replace(
        bench.run.limits, generations=10**6, steps=10**12, minutes=1e6, target=1e6, parted=3
    )
    Rows.touched = 0
    snapshot = snapshot_of(bench)
    encode_status(snapshot)
    assert bench.run._stop_reason(bench.run.generation) is None
    return Rows.touched


def test_a_snapshot_costs_the_same_however_long_the_run_is(bench):
    few, many = touched(bench, 100), touched(bench, 5000)
    assert few == many
    assert few < 100


def test_the_last_snapshot_says_left_unless_the_run_has_ended(bench):
    assert snapshot_of(bench).as_left().status.state == "left"
    while bench.run.state.ended is None:
        score(bench, 1)
    assert snapshot_of(bench).as_left().status.state == "ended"
    assert json.loads(encode_status(snapshot_of(bench).as_left()))["why"] == "3 generations"


def test_the_status_says_what_paused_the_run_for_programs(bench):
    assert snapshot_of(bench).status.pauses == ()
    for pause in (Pause(PauseKind.FAILED_JOB, ""), BY_HAND):
        bench.run.pause(pause)
    status = read_status(answered(snapshot_of(bench)))
    assert (status.state, status.pauses) == ("paused", (PauseKind.BY_HAND, PauseKind.FAILED_JOB))
    bench.run.resume()
    assert read_status(answered(snapshot_of(bench))).pauses == ()


def test_a_workers_status_holds_its_job_seconds_round_trip_and_resent_batches(bench):
    first = snapshot_of(bench).workers[0]
    assert (first.job_seconds, first.round_trip, first.resent) == (None, None, 0)
    (send,) = [each for each in bench.run.fleet.dispatch(0.0) if each.identity == A]
    bench.now = 0.25
    bench.handle_heartbeat(A)
    assert snapshot_of(bench).workers[0].round_trip == 0.25
    bench.answer(Result(send.work[0].job.digest, 1.0, 10, 0.1, None, None))
    bench.run.fleet.dispatch(bench.now)  # its verdict, which no beat shows as seen
    bench.run.fleet.dispatch(bench.now + 30.0)
    last = snapshot_of(bench).workers[0]
    assert (last.job_seconds, last.round_trip, last.resent) == (0.1, 0.25, 1)
    assert WorkerStatus(**answered(snapshot_of(bench), "workers")["workers"][0]) == last


def test_generations_of_one_fitness_are_counted_and_warned_of_once(make_bench, caplog):
    bench = make_bench(Bench, SCORED, generations=20)
    log = RunLog(bench.run, "night", Network(), bench.now)
    for closed in range(7):
        score(bench, 8, lambda job: 1.0)
        assert snapshot_of(bench).status.equal == closed + 1
        log.report_closed([bench.run.history.last])
    warned = [each.facts for each in caplog.records if getattr(each, "facts", {}).get("event") == "equal fitness"]
    assert [each["generation"] for each in warned] == [ENOUGH - 1]
    assert read_status(answered(snapshot_of(bench))).equal_fitness
    score(bench, 8)
    assert snapshot_of(bench).status.equal == 0
    assert not read_status(answered(snapshot_of(bench))).equal_fitness
    score(bench, 8, lambda job: 500.0)
    assert snapshot_of(bench).status.has_risen


@pytest.mark.parametrize(("took", "waits"), [(0.0, 0.005), (0.001, 0.005), (0.05, 0.05), (0.3, 0.2), (3600.0, 0.2)])
def test_a_commit_waits_as_long_as_the_last_one_took_and_never_long(took, waits):
    assert next_commit(100.0, 100.0 + took) == pytest.approx(100.0 + took + waits)


def test_the_summary_shows_generation_score_speed_workers_and_time_left():
    status = dataclasses.replace(STATUS, limits={"minutes": 30.0}, throughput=Throughput(987.5, 448000, 1080.0))
    text, facts = summary(status)
    parts = "7: 3 of 8 episodes", "120.5 ± 7.8", "988 steps/s", "1 worker", "8 slots", "18 of 30 minutes", "12 min"
    assert [part for part in parts if part not in text] == []
    assert (facts["generation"], facts["workers"]) == (7, 1)
    assert summary(dataclasses.replace(STATUS, best=None))[1]["best"] is None


def test_the_summary_counts_failed_candidates():
    opened = dataclasses.replace(STATUS.generation, failed=1)
    text, facts = summary(dataclasses.replace(STATUS, failed=2, generation=opened))
    assert "3 failed candidates" in text
    assert facts["failed"] == 3


def test_no_generation_is_named_once_a_limit_is_reached():
    confirming = dataclasses.replace(STATUS, state="evaluating", ending=True, confirming=EpisodeProgress(3, 16))
    for status in (confirming, dataclasses.replace(STATUS, state="paused", ending=True)):
        assert "generation 7" not in summary(status)[0]
    assert "3 of 16 episodes" in summary(confirming)[0]


def test_the_worker_command_names_an_address_that_other_hosts_reach():
    assert worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "car-racing") == (
        "dreamfleet worker --run night --connect tcp/127.0.0.1:7447"
    )
    everywhere = worker_command(Network(listen=("tcp/0.0.0.0:7448", "tcp/[::]:7449")), "night", "car-racing")
    assert everywhere.endswith(f"--connect tcp/{socket.gethostname()}:7448 tcp/{socket.gethostname()}:7449")
    own = worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "field:FieldTask")
    assert own.endswith("--connect tcp/127.0.0.1:7447 --task field:FieldTask")
    assert "--task" not in worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "gym:CartPole-v1")
    assert "tcp/router:1" in worker_command(Network(connect=("tcp/router:1",)), "night", "car-racing")


def test_with_join_files_the_worker_command_names_the_workers_own():
    credentials = Credentials("coordinator", 1, "home", datetime.now(UTC) + timedelta(days=90), "")
    command = worker_command(Network(listen=("tls/0.0.0.0:7447",), credentials=credentials), "night", "car-racing")
    assert command == "dreamfleet worker --run night --join FILE"
