"""A run's fingerprint is that of its first accepted result, and every accepted result has it."""

from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dreamfleet.common.messages import HelloRequest, Result, ResultBatch
from dreamfleet.common.runs import RunFolder
from tests.coordinator.test_run import SETTINGS, A, B, Bench
from tests.support.samples import SPEC

PLAIN = replace(SETTINGS, collect_every=0, population=4)


class Mixed(Bench):
    """Hosts of two fingerprints."""

    fingerprints = {A: "here", B: "elsewhere"}  # noqa: RUF012
    mixed = False

    def begin(self):
        super().begin()
        for name in (A, B):
            self.hello(name)

    def request(self, name):
        return HelloRequest(1, 1, "0", name, (SPEC.task,), self.fingerprints[name], 1)

    def hello(self, name):
        """Why it is refused, if it is."""
        found = self.run.exchange.refusal(self.request(name), self.settings)
        if found is None:
            self.run.exchange.admit(self.request(name), self.now)
            self.beat(name)
        return found

    def deliver(self, name, result):
        batch = ResultBatch(run_uid=self.run.uid, incarnation=1, fingerprint=self.fingerprints[name], results=(result,))
        self.run.exchange.results(name, batch, self.now)
        self.run.advance(self.now)
        self.run.commit()

    def given(self):
        return {
            send.identity: [work.job for work in send.content.work] for send in self.run.exchange.dispatch(self.now)
        }

    def stored(self):
        with RunFolder(self.path) as folder:
            return {each.fingerprint for number in range(4) for each in folder.results(0, number)}


@pytest.fixture
def bench(tmp_path, random_bundle):
    made = Mixed(tmp_path / "night", random_bundle.path, PLAIN)
    yield made
    made.journal.close()


def done(job):
    return Result(job.digest, 1.0, 10, 0.1, None, None)


def test_a_hello_without_a_result_fixes_nothing(bench):
    assert bench.run.exchange.fingerprint is None
    bench.restart()
    assert bench.hello(A) is bench.hello(B) is None


def test_the_first_accepted_result_fixes_it_and_the_other_host_must_go(bench):
    jobs = bench.given()
    bench.deliver(B, done(jobs[B][0]))
    assert bench.run.exchange.fingerprint == "elsewhere"
    bench.deliver(A, done(jobs[A][0]))
    assert bench.run.generation.done == 1, "a result of another fingerprint does not count"
    assert [member.identity for member in bench.run.exchange.members] == [B]
    why, remedy = bench.hello(A)
    assert "fingerprints differ" in why
    assert "--mixed" in remedy
    assert any("fingerprints differ" in note for note in bench.run.exchange.take_notes())
    assert {job.digest for job in bench.given()[B]} >= {job.digest for job in jobs[A]}, "its jobs are free again"
    assert bench.run.exchange.failures == [], "it is no failure of the job"
    bench.restart()
    assert bench.run.exchange.fingerprint == "elsewhere"


def test_an_error_fixes_nothing(bench):
    jobs = bench.given()
    bench.deliver(B, Result(jobs[B][0].digest, None, 0, 0.1, "boom", None))
    assert bench.run.exchange.fingerprint is None
    bench.deliver(A, done(jobs[A][0]))
    assert bench.run.exchange.fingerprint == "here"


def test_a_result_of_another_life_is_judged_before_its_worker_says_hello(bench):
    jobs = bench.given()
    bench.deliver(A, done(jobs[A][0]))
    bench.restart()
    bench.deliver(B, done(jobs[B][0]))
    assert bench.run.generation.done == 1


def test_a_mixed_run_takes_all(tmp_path, random_bundle):
    class Any(Mixed):
        mixed = True

    bench = Any(tmp_path / "night", random_bundle.path, PLAIN)
    jobs = bench.given()
    for name in (A, B):
        bench.deliver(name, done(jobs[name][0]))
    assert bench.run.generation.done == 2
    assert bench.hello(A) is bench.hello(B) is None
    bench.journal.close()


def test_an_old_journal_that_a_hello_froze_is_free_again(bench):
    bench.journal.set_fact("fingerprint", "a host that never scored")
    bench.journal.commit()
    bench.restart()
    assert bench.run.exchange.fingerprint is None


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.lists(st.tuples(st.sampled_from(["give", "hello", "restart"]), st.sampled_from([A, B])), max_size=30))
def test_in_any_order_a_journal_holds_one_fingerprint(tmp_path_factory, random_bundle, order):
    bench = Mixed(tmp_path_factory.mktemp("run") / "night", random_bundle.path, PLAIN)
    held = {A: {}, B: {}}
    for what, name in order:
        for who, jobs in bench.given().items():
            held[who].update({job.digest: job for job in jobs})
        if what == "restart":
            bench.restart()
        elif what == "hello":
            bench.hello(name)
        elif held[name]:
            bench.deliver(name, done(held[name].popitem()[1]))
        assert len(bench.stored()) <= 1
    bench.journal.close()
