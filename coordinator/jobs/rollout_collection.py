"""Rollouts of the mean that are kept, so that the next world model learns from what evolved controllers see."""

from collections.abc import Container, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from dreamfleet.common.errors import write_error
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import Result, TaskSpec
from dreamfleet.common.runs.run_paths import rollout_path
from dreamfleet.common.runs.seeds import collection_seed
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob, make_jobs
from dreamfleet.coordinator.jobs.upload_assembler import UploadAssembler

NOT_KEPT = Failure("the rollout was not kept: update dreamfleet on this host", "the rollout was not kept")


@dataclass(frozen=True)
class RolloutCollection:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` training tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec, run_seed: int, run_spec: TaskSpec | None = None) -> list[ScoringJob]:
        """The jobs of this collection; `run_spec` is the run's specification if `spec` differs from it."""
        seeds = [collection_seed(run_seed, self.generation, episode) for episode in range(self.episodes)]
        return make_jobs(spec, "collect", self.generation, 0, self.vector, seeds, run_spec)


class RolloutCollections:
    """A run's kept rollouts: which are missing, and their files in the run's `folder`."""

    def __init__(self, folder: Path) -> None:
        self.uploads = UploadAssembler()
        self._folder = folder
        self._missing: set[bytes] = set()  # digests
        self._scheduled = 0  # rollouts of the whole run

    def open(self, work: list[ScoringJob], known: Container[bytes]) -> list[ScoringJob]:
        """Want these rollouts; return the jobs of those that are not kept already."""
        missing = [each for each in work if each.digest not in known]
        self._scheduled += len(work)
        self._missing.update(each.digest for each in missing)
        return missing

    def remove(self, recalled: Iterable[tuple[int, int]]) -> None:
        """Remove the files of these rollouts, by generation and episode; no reader takes one that cannot be removed."""
        for generation, episode in recalled:
            with suppress(OSError):
                rollout_path(self._folder, generation, episode).unlink(missing_ok=True)

    def finish(self, digest: bytes) -> None:
        """Count a rollout whose result was accepted."""
        self._missing.discard(digest)

    @property
    def missing_count(self) -> int:
        """How many rollouts are missing."""
        return len(self._missing)

    @property
    def progress(self) -> tuple[int, int]:
        """Rollouts of the whole run: kept, wanted."""
        return self._scheduled - len(self._missing), self._scheduled

    def receive(self, worker: str, result: Result, work: ScoringJob | None) -> Result | None:
        """The result to judge, with its rollout saved; `None` while the rollout is on its way.

        R6: the rollout is on disk before the result can get a verdict, so a crash loses no rollout.
        """
        if work is None or work.kind != "collect" or result.fitness is None:
            return result
        if result.upload is None:
            return replace(result, fitness=None, error=NOT_KEPT)
        data = self.uploads.get_complete(worker, result.digest, result.upload)
        if data is None:
            return None
        path = rollout_path(self._folder, work.job.generation, work.job.episode)  # docs/reference/files.md
        try:
            with atomic_write(path) as file:
                file.write(data)
        except OSError as error:
            raise write_error(path, error) from error
        return result
