"""What failed attempts prove: a broken host, or an episode that fails wherever scored. Pure. Pages: threats.md."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

from dreamfleet.common.protocol.keys import host_of
from dreamfleet.coordinator.dispatch.failures import Attempt
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob, PendingJobs

EQUAL_ATTEMPTS = 2  # with one cause; said by `--on-failure`, docs/reference/python.md, docs/how-to/ask-tell.md
ANY_ATTEMPTS = 3  # with several causes: either shows that the episode fails
HOST_ATTEMPTS = 10  # that a host's shortage ends, over about eight minutes: no host has what the episode needs
PAUSING_ATTEMPTS = 3  # on the only worker
MAX_CAUSES = 20  # that are logged: a simulator may invent names without end
ENOUGH_JOBS = 10  # of which none could be scored show that no host can


class FailureJudge:
    """Judges the failures of `jobs`; `members` are the workers that are here."""

    def __init__(self, jobs: PendingJobs, members: Mapping[str, Member]) -> None:
        self.working_hosts: set[str] = set()  # names of those that scored jobs of this run
        self.lacks_control_job = False  # no scored job is known that could show whether a new host can score
        self._causes: set[str] = set()  # that were seen
        self._jobs = jobs
        self._members = members

    def is_new_cause(self, failure: PendingJob) -> bool:
        """Whether a job's last attempt failed for a cause that was not seen before; of the first causes only."""
        cause = failure.attempts[-1].error.cause
        is_new = cause not in self._causes and len(self._causes) < MAX_CAUSES
        if is_new:
            self._causes.add(cause)
        return is_new

    def find_lasting(self) -> list[PendingJob]:
        """The wanted jobs that fail wherever they are scored.

        R8: another host must have failed too, but not one that failed a job that was scored before.
        """
        failures = self._jobs.failures
        hosts = self._present_hosts() - {one.host for each in failures if each.is_control for one in each.attempts}
        working = self.working_hosts
        return [each for each in failures if not each.is_control and is_lasting(each.attempts, working, hosts)]

    def find_pausing(self) -> PendingJob | None:
        """A job that failed so often that the run must pause; `None` if there is none.

        R8: two workers, or three attempts on the only one, show that the job itself or every host is at fault. A host
        that fails a job which others scored is faulty. This does not matter while another host works.
        """
        forgives_control_jobs = bool(self._present_hosts() & self.working_hosts)
        failures = (each for each in self._jobs.failures if not (each.is_control and forgives_control_jobs))
        return next((each for each in failures if _is_pausing([each])), None)

    def find_broken_fleet(self, *, at_once: bool) -> PendingJob | None:
        """The job that failed most often, if all hosts that are here have failed and none of them has ever scored.

        R8: all open jobs must have failed, or with `at_once` ten of them while the run has no score from anywhere.
        Before that, a host that works may still show itself. Ten failures of one job where none has scored are enough,
        too, for each end of a worker may bring a host with a new name.
        """
        failures = self._jobs.failures
        for each in failures:
            if len(each.attempts) >= HOST_ATTEMPTS and not any(one.host in self.working_hosts for one in each.attempts):
                return each
        if not self._present_hosts() or self.may_recover or not _is_pausing(failures):
            return None
        is_early = at_once and not self.working_hosts and len(failures) >= ENOUGH_JOBS
        if not is_early and len(failures) < len(self._jobs):
            return None
        return max(failures, key=lambda each: len(each.attempts))

    @property
    def awaits_control_job(self) -> bool:
        """Whether only suspects and failed jobs are open, and an idle host has not scored, while others have."""
        idle = {host_of(name) for name, each in self._members.items() if each.takes_jobs and not each.leases}
        if not self.working_hosts or idle <= self.working_hosts:
            return False
        wanted = [each for each in self._jobs.values() if each.check is None]
        return bool(wanted) and all(each.is_suspect or (each.attempts and not each.is_control) for each in wanted)

    @property
    def hosts_for_suspects(self) -> Collection[str]:
        """The hosts that may be given suspects; empty: any host.

        R8: hosts that have scored, if one is here, or if another that is here can still show that it can score.
        """
        return () if self.lacks_control_job and not self._present_hosts() & self.working_hosts else self.working_hosts

    @property
    def has_failed_control_job(self) -> bool:
        """Whether a job that was scored before is wanted again and failed."""
        return any(each.is_control for each in self._jobs.failures)

    @property
    def may_recover(self) -> bool:
        """Whether a host is here that has scored, or that has not failed yet."""
        hosts = self._present_hosts()
        tried = {attempt.host for each in self._jobs.failures for attempt in each.attempts}
        return bool(hosts & self.working_hosts or hosts - tried)

    def _present_hosts(self) -> set[str]:
        """The names of the hosts that are here, also while they replace a scoring process and take no job."""
        return {host_of(name) for name, member in self._members.items() if member.has_been_ready}


def is_lasting(attempts: Sequence[Attempt], working: Collection[str], present: Collection[str]) -> bool:
    """Whether the failure follows from the parameters and the seed, so that every host would fail.

    R8: it takes two attempts with one cause, or three with any, on hosts that have scored jobs of this run (`working`,
    by name), and on two hosts while a host that is `present` has not tried it yet. A shortage of the host (memory,
    disk, processes) counts only after ten attempts.
    """
    able = [each for each in attempts if each.host in working]
    own = [each for each in able if each.error.kind != "host"]
    if len(able) - len(own) >= HOST_ATTEMPTS:
        return True
    is_untried = bool(set(present) - {each.host for each in attempts})
    if is_untried and len({each.host for each in own}) < 2:
        return False
    most = max(Counter(each.error.cause for each in own).values(), default=0)
    return most >= EQUAL_ATTEMPTS or len(own) >= ANY_ATTEMPTS


def _is_pausing(failures: Sequence[PendingJob]) -> bool:
    attempts = [attempt for each in failures for attempt in each.attempts]
    return len({each.worker for each in attempts}) > 1 or len(attempts) >= PAUSING_ATTEMPTS
