"""Which hosts may add to a run: those that know its task and, if the run is strict, compute like its first host."""

from collections.abc import Collection

from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.protocol.host_classes import effective_class
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import HelloRequest
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.security.credentials import worker_seat_identity
from dreamfleet.common.security.host_key import is_token_of
from dreamfleet.coordinator.dispatch.event_log import Note
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.refusals import Refusal, RefusedWorkers, class_mismatch, find_refusal
from dreamfleet.coordinator.storage.journal import FINGERPRINT, HOST_CLASS, Journal
from dreamfleet.coordinator.storage.verification_records import StoredBar

BARRED_REMEDY = "test its memory and its installation; then start its worker with another --name, or --join file"


class WorkerAdmission:
    """Admits workers to a run's fleet and removes those of a foreign class; only a `strict` run has foreign classes."""

    def __init__(
        self, journal: Journal, settings: RunSettings, fleet: Fleet, *, strict: bool, host_key: bytes = b"",
        is_secured: bool = False,
    ) -> None:  # fmt: skip
        """Of a secured fleet (`is_secured`), all hosts that share a join file are one voter (R32)."""
        self.strict = strict
        self.refused_workers = RefusedWorkers()
        # Of the first accepted result; `None` before it.
        self.fingerprint, self.host_class = journal.fingerprint(), journal.host_class()
        self.barred = journal.verification.barred()  # by host
        self._journal = journal
        self._settings = settings
        self._fleet = fleet
        self._host_key = host_key
        self._voter_of = fleet.jobs.voter_of = worker_seat_identity if is_secured else host_of
        self._list_barred_voters()

    def find_refusal(self, request: HelloRequest) -> Refusal | None:
        """Why a worker cannot join; `None` if it may."""
        settings = self._settings
        admitted = self.host_class if self.strict else None
        found = find_refusal(request, settings.task.task, admitted, settings.packages)
        if (bar := self._bar_of(request.worker)) is not None:
            host = host_of(request.worker)
            again = shell_command("bar", host, self._journal.path.parent.name, "--no-longer")
            operator = f"ask the run's operator, who can let it in again with `{again}`"
            remedy = operator if bar.by_operator else BARRED_REMEDY
            found = Refusal(f"it is barred from this run: {bar.why}", remedy)
        final = request.packages == settings.packages  # otherwise the worker says hello again with these packages
        if found is not None and final and self.refused_workers.add(request.worker, found.why):
            note = Note(f"refused worker {request.worker}: {found.why}", "refused", request.worker)
            self._fleet.note_refusal(note, found.why)
        return found

    def admit(self, request: HelloRequest, now: float) -> int:
        """Add a worker to the fleet; the number that its batches will carry."""
        self.refused_workers.remove(request.worker)
        known = self._fleet.members.get(request.worker)
        numbering = self._fleet.add_worker(request.worker, request.slots, request.fingerprint, now)
        if (member := self._fleet.members[request.worker]) is not known:
            member.host_class = self.class_of(request.host_class, request.fingerprint)
            member.is_trusted = is_token_of(self._host_key, request.worker, request.host_token)
        return numbering

    def update_class(self, worker: str, host_class: str) -> None:
        """Note the class that a heartbeat names, and remove a worker whose class is foreign."""
        member = self._fleet.members.get(worker)
        if member is not None and host_class:
            member.host_class = self.class_of(host_class, member.fingerprint)
            self._enforce_class(member)

    def class_of(self, host_class: str, fingerprint: str) -> str:
        """The class under which this run counts a host; empty if it is not known yet."""
        return effective_class(host_class, fingerprint, self.host_class)

    def distrust_reason(self, worker: str, host_class: str, fingerprint: str) -> str | None:
        """Why results that name this class and fingerprint do not count; `None` if they may.

        Anybody can send messages in a worker's name: a fingerprint other than that of the worker's hello is not its.
        """
        if self._bar_of(worker) is not None:
            return "result of a barred host"
        member = self._fleet.members.get(worker)
        if member is not None and member.fingerprint != fingerprint:
            return "result of another fingerprint than its worker's"
        if self._accepts_class(host_class):
            return None
        if member is not None and not (member.host_class and self._accepts_class(member.host_class)):
            self._remove_foreign_class(worker, host_class, fingerprint)
        return "result of another class than the run's"

    def adopt_class(self, host_class: str, fingerprint: str) -> None:
        """Make the first accepted result's class and fingerprint the run's, in the transaction that writes it."""
        if self.host_class is not None:
            return
        self.host_class, self.fingerprint = host_class, fingerprint
        self._journal.set_fact(HOST_CLASS, host_class)
        self._journal.set_fact(FINGERPRINT, fingerprint)
        for member in list(self._fleet.members.values()):
            member.host_class = self.class_of(member.host_class, member.fingerprint)
            self._enforce_class(member)

    def bar(self, host: str, bar: StoredBar, incarnation: int) -> set[str]:
        """Keep a host out of this run from now on, by the journal too; its workers are removed. The hosts: this one."""
        self._journal.verification.bar(host, bar, incarnation)
        self.barred[host], why = bar, bar.why
        self._list_barred_voters()
        for worker in [each for each in self._fleet.members if host_of(each) == host]:
            self._fleet.remove_worker(worker)
        self.refused_workers.add(host, f"it is barred from this run: {why}")
        self._fleet.note_refusal(Note(f"host {host} is barred from this run: {why}", "barred", host), f"barred: {why}")
        return {host}

    def unbar(self, host: str) -> None:
        """Let a host join this run again, by the journal too."""
        self._journal.verification.unbar(host)
        del self.barred[host]
        self._list_barred_voters()
        self.refused_workers.remove(host)

    def hosts_of(self, voters: Collection[str]) -> list[str]:
        """The hosts of these voters that scored in this run or are here, sorted."""
        return sorted(host for host in self.known_hosts() if self._voter_of(host) in voters)

    def known_hosts(self) -> set[str]:
        """The hosts that scored in this run, or are or were here."""
        scored = self._journal.results.workers(recalled=True)
        return {*map(host_of, (*scored, *self._fleet.members, *self._fleet.departed))}

    def _bar_of(self, worker: str) -> StoredBar | None:
        """The bar of a worker's host, or that a check found its voter wrong under another name."""
        return self.barred.get(host_of(worker)) or self._barred_voters.get(self._voter_of(worker))

    def _list_barred_voters(self) -> None:
        by_checks = {host: bar for host, bar in self.barred.items() if not bar.by_operator}
        self._barred_voters = {self._voter_of(host): bar for host, bar in by_checks.items()}

    def _accepts_class(self, host_class: str) -> bool:  # docs/how-to/mixed-hosts.md
        return not self.strict or self.host_class in (None, host_class)

    def _enforce_class(self, member: Member) -> None:
        if member.host_class and not self._accepts_class(member.host_class):
            self._remove_foreign_class(member.identity, member.host_class, member.fingerprint)

    def _remove_foreign_class(self, worker: str, host_class: str, fingerprint: str) -> None:
        """Remove a worker of another class: it says hello again, and the refusal explains why and what to do.

        Its results get no verdict, so that it does not take silence for success.
        """
        why = class_mismatch(self.host_class, host_class, fingerprint).why
        self._fleet.remove_worker(worker)
        if self.refused_workers.add(worker, why):
            self._fleet.note_refusal(Note(f"worker {worker} must go: {why}", "left", worker), why)
