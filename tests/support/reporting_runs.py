"""Runs that report a controller."""

from dataclasses import replace

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_paths import CONTROLLER
from tests.support.run_bench import SETTINGS, Bench

EVALUATED = replace(SETTINGS, collect_every=0, evaluate_every=2, evaluation_episodes=2, population=4)

SCORES = {1: 10.0, 3: 5.0}  # of the mean after a generation


class Reporting(Bench):
    def fitness_of(self, job):
        return SCORES[job.generation] if job.kind == "evaluate" else float(job.digest[0])

    def close(self, generations):
        """Answer jobs until so many generations are closed and no background job is in progress."""
        while len(self.run.history) < generations or self.run.background_jobs.in_progress:
            self.step()

    def saved(self):
        path = self.path / CONTROLLER
        return Controller.load(path) if path.exists() else None
