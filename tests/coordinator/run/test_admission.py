"""The first accepted result fixes a run's class; in a strict run all accepted results are of that class.
Tests common/protocol/host_classes.py."""

from dataclasses import replace

import pytest

from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.storage.verification_records import StoredBar
from tests.support.dispatched import result
from tests.support.failures import failure
from tests.support.run_bench import SETTINGS, A, B, Bench

PLAIN = replace(SETTINGS, collect_every=0, population=4)
HERE, ELSEWHERE = class_from_fingerprint("here"), class_from_fingerprint("elsewhere")


class Classed(Bench):
    """Hosts of two classes."""

    fingerprints = {A: "here", B: "elsewhere"}  # noqa: RUF012
    classes = {A: "a" * 16, B: "b" * 16}  # noqa: RUF012
    strict = True

    def begin(self):
        self.announced = {A: "", B: ""}
        super().begin()

    def fingerprint_of(self, name):
        return self.fingerprints[name]

    def class_of(self, name):
        return self.announced[name]  # a worker finds out its class after it has joined

    def find_out(self, name):
        """The worker's child processes find its class, and its heartbeat says so."""
        self.announced[name] = self.classes[name]
        self.handle_heartbeat(name)

    def hello(self, name):
        """Why the worker is refused; `None` if it may join."""
        found = self.run.admission.find_refusal(self.request(name))
        if found is None:
            self.admit(name)
            self.handle_heartbeat(name)
        return found

    def send(self, name, *results):
        self.announced[name] = self.classes[name]
        super().send(name, *results)

    def digests(self):
        """Of the jobs that each worker is given now."""
        fetched = self.fetch()
        return {name: [job.digest for worker, job in fetched if worker == name] for name in (A, B)}

    def stored(self):
        with RunFolder(self.path) as folder:
            return {each.host_class for number in range(4) for each in folder.results(0, number)}


@pytest.fixture
def bench(make_bench):
    return make_bench(Classed, PLAIN)


class ByFingerprint(Classed):
    """Workers of a task without a probe episode."""

    classes = {A: HERE, B: ELSEWHERE}  # noqa: RUF012


@pytest.mark.parametrize("kind", [Classed, ByFingerprint])
def test_the_first_accepted_result_fixes_the_class_and_the_other_host_is_removed(make_bench, kind):
    bench = make_bench(kind, PLAIN)
    own = kind.classes[B]
    jobs = bench.digests()
    bench.deliver(B, result(jobs[B][0]))
    assert (bench.run.admission.host_class, bench.run.admission.fingerprint) == (own, "elsewhere")
    bench.deliver(A, result(jobs[A][0]))
    assert bench.run.generation.done == 1, "a result of another class does not count"
    assert list(bench.run.fleet.members) == [B]
    assert "--no-strict" in bench.hello(A).remedy
    assert any((note.what, note.worker) == ("left", A) for note in bench.run.take_notes())
    assert {*bench.digests()[B]} >= {*jobs[A]}, "its jobs are free again"
    assert bench.run.fleet.jobs.failures == [], "it is no failure of the job"
    bench.restart()
    assert bench.run.admission.host_class == own
    assert bench.hello(B) is None


def test_a_worker_of_another_class_is_removed_before_it_gets_work(bench):
    jobs = bench.digests()
    bench.deliver(B, result(jobs[B][0]))
    bench.run.fleet.remove_worker(A)
    assert bench.hello(A) is None, "it does not know its class yet"
    bench.find_out(A)
    assert list(bench.run.fleet.members) == [B]
    for each in (bench.classes[A], HERE):  # that of its fingerprint is another one too
        bench.announced[A] = each
        assert "--no-strict" in bench.hello(A).remedy


def test_hosts_of_one_fingerprint_may_be_of_two_classes_and_of_two_fingerprints_of_one(bench):
    bench.fingerprints = {A: "here", B: "here"}
    bench.restart()
    jobs = bench.digests()
    bench.deliver(B, result(jobs[B][0]))
    bench.deliver(A, result(jobs[A][0]))
    assert bench.run.generation.done == 1
    bench.fingerprints, bench.classes = {A: "there", B: "here"}, {A: "b" * 16, B: "b" * 16}
    bench.announced[A] = ""
    assert bench.hello(A) is None
    bench.deliver(A, result(jobs[A][0]))
    assert bench.run.generation.done == 2
    assert bench.stored() == {"b" * 16}
    (share,) = bench.run.journal.results.classes.largest
    assert (share.results, set(share.fingerprints)) == (2, {"here", "there"})


def test_neither_a_hello_nor_an_error_fixes_the_class(bench):
    jobs = bench.digests()
    bench.deliver(B, result(jobs[B][0], error=failure("boom")))
    assert bench.run.admission.host_class is None
    assert bench.hello(A) is bench.hello(B) is None
    bench.deliver(A, result(jobs[A][0]))
    assert bench.run.admission.host_class == "a" * 16


def test_a_result_of_another_life_is_judged_before_its_worker_says_hello(bench):
    jobs = bench.digests()
    bench.deliver(A, result(jobs[A][0]))
    bench.restart()
    bench.deliver(B, result(jobs[B][0]))
    assert bench.run.generation.done == 1


@pytest.mark.parametrize("classes", [{A: "a" * 16, B: "b" * 16}, {A: HERE, B: "b" * 16}, {A: "a" * 16, B: ELSEWHERE}])
def test_a_run_that_is_not_strict_accepts_all_classes_and_records_each_results_class(make_bench, classes):
    bench = make_bench(type("Open", (Classed,), {"strict": False, "classes": classes}), PLAIN)
    jobs = bench.digests()
    for name in (A, B):
        bench.deliver(name, result(jobs[name][0]))
    assert bench.run.generation.done == 2
    assert bench.hello(A) is bench.hello(B) is None
    # If the class of the first accepted result is that of its fingerprint, so are all.
    assert bench.stored() == ({HERE, ELSEWHERE} if classes[A] == HERE else {*classes.values()})
    assert bench.run.journal.results.classes.mixed
    with RunFolder(bench.path) as folder:
        assert folder.classes == bench.run.journal.results.classes


class Secured(Bench):
    """Of a fleet whose workers' names end in their seats."""

    workers = ("gpu.1/1", "gpu.2/1")
    is_secured = True


def test_a_bar_by_a_check_holds_for_all_names_of_a_join_file_and_one_by_the_operator_for_the_host(tmp_path):
    bench = Secured(tmp_path / "run", None, PLAIN)
    admission = bench.run.admission
    admission.bar("gpu.1", StoredBar("found"), 1)
    assert admission.find_refusal(bench.request("other.1/2")) is not None
    assert admission.find_refusal(bench.request("gpu.2/2")) is None
    admission.unbar("gpu.1")
    assert admission.find_refusal(bench.request("other.1/2")) is None
    admission.bar("gpu.1", StoredBar("known", by_operator=True), 1)
    assert admission.find_refusal(bench.request("other.1/2")) is None
    assert admission.find_refusal(bench.request("gpu.1/2")) is not None
