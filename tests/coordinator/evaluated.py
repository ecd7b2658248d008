"""A run whose means are evaluated, and whose jobs are finished in any order."""

from dreamfleet.common.protocol.messages import Result
from tests.support.run_bench import Bench

EVERY = 2  # generations from one evaluation to the next


class Evaluated(Bench):
    """`reality` are the scores of the means after generations 1, 3, 5, ...; any other mean scores `off_schedule`."""

    reality = ()
    off_schedule = 900.0  # of a mean that is evaluated because a limit was reached

    def begin(self):
        self.given = []
        super().begin()

    def fetch(self):
        for send in self.run.fleet.dispatch(self.now):
            self.given += [work.job for work in send.work]

    def finish(self, index):
        job = self.given.pop(index)
        if job.kind == "score":
            fitness = int.from_bytes(job.digest[:4], "little") / 1e6
        elif job.generation % EVERY:
            fitness = self.reality[job.generation // EVERY] + job.episode
        else:
            fitness = self.off_schedule
        self.answer(Result(job.digest, fitness, 10, 0.1, None, None))

    def first(self, kind):
        return next((index for index, job in enumerate(self.given) if job.kind == kind), None)

    def drive(self, choose, after=lambda: None):
        """To its end; what the scored jobs name of their specification, by generation."""
        found = {}
        while self.run.state.ended is None:
            self.fetch()
            found.update({job.generation: job.overrides for job in self.given if job.kind == "score"})
            self.finish(choose(self))
            after()
        return found
