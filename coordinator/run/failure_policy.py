"""When failures pause a run (R8): too many candidates fail, or no host can score. Pages: unattended.md."""

from contextlib import suppress

from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.dispatch.failures import WORKER_ENDED
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.run_state import Pause
from dreamfleet.coordinator.storage.journal import Journal

LIMIT_FROM = "limit_from"  # the fact that names the first generation whose failures count
OTHER_SEEDS = "; if the seeds of the first generation are bad for every candidate, begin a run with another --seed"
LOST_WORKERS = "; the last lines of these workers, and `dmesg` on their hosts, may say what ended them"


def forget_acceptance(journal: Journal, generation: int) -> None:
    """Let failures count again from this generation on, which is open again: what was accepted came after it."""
    with suppress(ValueError):
        if int(journal.fact(LIMIT_FROM) or 0) > generation + 1:
            journal.drop_fact(LIMIT_FROM)


class FailurePolicy:
    """At most the share `share` of the last generations' candidates may fail, and some host must be able to score."""

    def __init__(
        self, journal: Journal, fleet: Fleet, generations: Generations, settings: RunSettings, share: float
    ) -> None:
        self.share = share
        self.judges = settings.on_failure != "pause"  # whether lasting failures are facts of the run
        self._journal = journal
        self._fleet = fleet
        self._generations = generations
        self._is_external = settings.is_external
        self._since = 0
        with suppress(ValueError):  # of a damaged journal: then all generations count
            self._since = int(journal.fact(LIMIT_FROM) or 0)

    def accept(self, generation: int) -> None:
        """Count failures from the next generation on: somebody resumed the run."""
        self._since = generation + 1
        self._journal.set_fact(LIMIT_FROM, str(self._since))

    def find_excess(self, generation: Generation) -> Pause | None:
        """The pause because too many candidates failed; `None` if they did not, or if others submit them."""
        if self._is_external:
            return None  # who submits the candidates sees what fails
        failed, counted = self._generations.count_recent_failures(generation, self._since)
        total = len(counted) * generation.population
        if generation.all_failed and not self._generations.can_try_again(generation):
            why = (
                f"all candidates failed in generation {generation.number} on each set of seeds, so that none can be "
                "ranked; `dreamfleet resume` tries them again, `dreamfleet coordinator --from` begins another run at "
                "the mean"
            )
        elif failed > self.share * total:
            first, last = counted[0], counted[-1]
            where = f"generation {last}" if first == last else f"generations {first} to {last}"
            why = (
                f"{failed} of {plural(total, 'candidate')} failed in {where}; `dreamfleet resume` tries them again and "
                "continues, however many fail in this generation"
            )
        else:
            return None
        return Pause(PauseKind.FAILED_CANDIDATES, f"{why} (`dreamfleet story` lists why)")

    def find_pause(self, generation: Generation) -> Pause | None:
        """The pause because no host can score, or because a job failed that may not; `None` if there is no reason.

        First a host that has not scored gets a job that was scored before, to show whether it can.
        """
        judge, jobs = self._fleet.failure_judge, self._fleet.jobs
        judge.lacks_control_job = False
        broken = judge.find_broken_fleet(at_once=self.share < 1) if self.judges else None
        if not self.judges and (failure := judge.find_pausing()) is not None:
            return Pause(PauseKind.FAILED_JOB, f"{failure.describe_failure()}; `dreamfleet resume` tries it again")
        if broken is None and not judge.awaits_control_job:
            return None
        control = self._generations.find_scored(generation)
        if broken is None:
            judge.lacks_control_job = control is None or not jobs.offer_control_job(control)
        elif control is None or judge.has_failed_control_job or not jobs.offer_control_job(control):
            return self._no_able_host(broken, has_score=control is not None)
        return None

    def _no_able_host(self, failure: PendingJob, *, has_score: bool) -> Pause:
        jobs, until_host = self._fleet.jobs, not self._fleet.failure_judge.may_recover
        is_loss = all(each.error == WORKER_ENDED for each in failure.attempts)
        hint = LOST_WORKERS if is_loss else "" if has_score else OTHER_SEEDS
        why = (
            f"no present host has ever scored a job, and {len(jobs.failures)} of "
            f"{plural(len(jobs) + jobs.unmade, 'open job')} failed, such as {failure.describe_failure()}; "
            f"the run continues {'when another host joins, or ' * until_host}with `dreamfleet resume`{hint}"
        )
        return Pause(PauseKind.NO_ABLE_HOST, why, until_host=until_host)
