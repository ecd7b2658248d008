"""Runs whose episodes fail where a test says so."""

from dataclasses import replace

from dreamfleet.common.runs.run_folder import RunFolder
from tests.support.dispatched import result
from tests.support.failures import failure
from tests.support.run_bench import SETTINGS as TWO
from tests.support.run_bench import A, B, Bench

SETTINGS = replace(TWO, population=6, episodes=2, collect_every=0, on_failure="worst")

GENERATIONS = 3


def pause_kinds(bench):
    """What paused the run, the latest first."""
    return [each.kind for each in bench.run.state.paused.pauses]


class Failing(Bench):
    """A bench whose episodes fail where `fails(job)`; everything else scores by its digest. Other `hosts` are gone."""

    host_class = "0123456789abcdef"

    def __init__(self, *args, fails, host_errors=(), limit=0.5, hosts=(A, B), **kwargs):
        self.fails, self.host_errors, self.failure_limit = fails, list(host_errors), limit
        self.hosts = [*hosts]
        super().__init__(*args, generations=GENERATIONS, **kwargs)
        for name in {A, B}.difference(hosts):
            self.run.fleet.handle_departure(name, self.now)

    def fitness_of(self, job):
        return int.from_bytes(job.digest[:3]) / 1e6

    def answer_one(self, name, job):
        if self.host_errors:
            answer = result(job.digest, error=self.host_errors.pop(), steps=0)
        elif self.fails(job):
            answer = result(job.digest, error=failure("ValueError", f"at {id(job):#x} on {name}"), steps=3)
        else:
            answer = result(job.digest, self.fitness_of(job))
        self.deliver(name, answer)

    def serve(self, turns=400, stop=lambda run: False):
        for _ in range(turns):
            if self.run.state.ended or self.run.state.paused or stop(self.run):
                return
            self.wait()
            self.run.advance(self.now)
            for name in self.hosts:
                self.handle_heartbeat(name)
            for name, job in self.fetch():
                self.answer_one(name, job)
        raise AssertionError("the run does not end")

    def story(self):
        """What a run computed, without times."""
        self.journal.commit()
        with RunFolder(self.path) as folder:
            rows = [replace(each, seconds=0.0) for each in folder.history()]
            counted = folder.candidates()
            for row in rows:
                own = [each for each in counted if each.generation == row.number]
                assert sum(each.steps for each in own) == row.steps
                assert {(each.episodes, each.steps) for each in own if each.fitness is None} <= {(0, 0)}
                most = len(folder.training_seeds(row.number))
                episodes = {most, -(-most // 2)} if self.settings.racing else {most}
                assert {each.episodes for each in own if each.fitness is not None} <= episodes
            candidates = [(each.generation, each.number, each.fitness) for each in counted]
            vectors = [folder.candidate(*each[:2]).tobytes() for each in candidates]
            return rows, candidates, vectors, folder.evaluations(), folder.confirmation()


def by_vector(share):
    """An episode fails by its parameters and its seed."""
    return lambda job: job.kind == "score" and (job.vector[0] + job.seeds[0]) % 256 < share * 256


def finished(path, bundle, settings=SETTINGS, **options):
    bench = Failing(path / "night", bundle.path, settings, **options)
    bench.serve()
    return bench
