"""Faults that are planted in the pure parts, one rule each: a simulation that does not find them proves nothing.

Each mutant replaces one function by one that forgets a rule. Its `shape` turns the drawn schedules to where the rule
matters, for rules that few shapes exercise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np

from dreamfleet.common.protocol.messages import MAX_PART
from dreamfleet.common.runs.stages import StageTracker, stages_of
from dreamfleet.coordinator.dispatch import failure_judge, member, packing
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.leases import Leases
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJobs
from dreamfleet.coordinator.jobs.checks import Check
from dreamfleet.coordinator.jobs.confirmation import Confirmation
from dreamfleet.coordinator.jobs.evaluation import Evaluations
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollections
from dreamfleet.coordinator.jobs.upload_assembler import UploadAssembler as Intake
from dreamfleet.coordinator.run import generations
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.verification import Verification
from dreamfleet.worker.service.backlog import Backlog, PartialVector
from dreamfleet.worker.service.membership import Membership
from dreamfleet.worker.service.outbox import Outbox, UploadQueue
from tests.simulation.schedule import Schedule, draw
from tests.simulation.world import Outcome, play


@dataclass(frozen=True)
class Mutant:
    """One attribute that is replaced, and the shape in which that should be noticed."""

    target: Any
    attribute: str
    replacement: Any
    shape: Mapping[str, Any] = field(default_factory=dict)

    @contextmanager
    def planted(self) -> Iterator[None]:
        """The product without this rule."""
        with patch.object(self.target, self.attribute, self.replacement):
            yield

    def schedule(self, seed: int, number: int) -> Schedule:
        """The schedule of that number, in a shape that has what the mutant is about."""
        drawn = draw(seed, number)
        return replace(drawn, shape=replace(drawn.shape, **self.shape))

    def find(self, seed: int, most: int) -> tuple[int, Outcome] | None:
        """Which schedule finds it first, and how; `None` if none of so many does.

        Rules that few schedules exercise are found by those that once broke them, numbered from -1 down.
        """
        with self.planted():
            for number in [*range(most), *range(-1, -len(FOUND) - 1, -1)]:
                outcome = play(self.schedule(seed, number) if number >= 0 else FOUND[number])
                if outcome.violation is not None:
                    return number, outcome
        return None


FOUND = [Schedule.from_json(line) for line in Path(__file__).with_name("found.jsonl").read_text().splitlines()]
CHECKED = {"verify": 1.0}
COLLECTING = {"collect_every": 1, "rollout": 90_000}
SCORED = {"evaluate_every": 1, "first_stage": 3, "first_score": 1.2, "generations": 3}
FAILING = {"on_failure": "redraw", "failing": 0.15}
LONG = {"parameters": 23_000, "width": 1}


# What does nothing, or the same in every case. Mutants of a recall are in `test_liars.py`.
MUTANTS: dict[str, Mutant] = {
    "checks_ask_the_host_that_answered": Mutant(Check, "may_ask", lambda self, host, host_class: True, CHECKED),
    "checks_wait_for_hosts_that_are_not_there": Mutant(
        Verification, "settle", lambda self, now: None, {**CHECKED, "workers": 1}
    ),
    "checks_are_forgotten_in_a_restart": Mutant(Verification, "restore", lambda self, work: None, CHECKED),
    "checks_of_a_confirmation_are_forgotten_in_a_restart": Mutant(
        BackgroundJobs,
        "_check_again",
        lambda self, work: False,
        {**CHECKED, "confirm_episodes": 4, "evaluate_every": 1, "ends": True},
    ),
    "generations_do_not_wait_for_their_checks": Mutant(Verification, "holds_generation", False, CHECKED),
    "fleet_never_sends_a_batch_again": Mutant(Member, "take_overdue_batches", lambda self, now, after: iter(())),
    "fleet_never_misses_a_job_that_beats_do_not_show": Mutant(member, "ABSENT_HEARTBEATS", 10**9),
    "fleet_asks_for_results_of_nobody": Mutant(Fleet, "find_job_for_result", lambda self, identity, result: None),
    "member_counts_on_after_a_silence": Mutant(Member, "start_numbering", lambda self, numbering: None),
    "jobs_remember_every_acceptance": Mutant(PendingJobs, "begin_generation", lambda self, generation: None),
    "jobs_keep_their_failures_when_the_run_is_resumed": Mutant(PendingJobs, "clear_failures", lambda self: None),
    "member_has_credit_whatever_it_holds": Mutant(
        Member, "credit", property(lambda self: 2 * self.capacity if self.is_reachable else 0)
    ),
    "generations_forget_the_results_of_the_life_before": Mutant(
        Generations,
        "_recall",
        lambda self, stored, terms: self._generation(stored.number, stored.vectors, stored.seeds, terms),
    ),
    "generations_rank_failed_candidates_above_the_worst": Mutant(
        generations, "_ranked", lambda fitness, worst: np.where(np.isfinite(fitness), fitness, worst + 0.5), FAILING
    ),
    "failures_become_facts_after_one_attempt": Mutant(
        failure_judge, "is_lasting", lambda attempts, working, present: True, FAILING
    ),
    "collections_accept_a_rollout_that_has_not_come": Mutant(
        RolloutCollections, "receive", lambda self, _worker, result, _work: result, COLLECTING
    ),
    "intake_never_lets_go_of_a_file": Mutant(Intake, "forget", lambda self, digest: None, COLLECTING),
    "outbox_ignores_verdicts": Mutant(Outbox, "acknowledge", lambda self, digests: None),
    "uploads_go_on_after_the_verdict": Mutant(UploadQueue, "acknowledge", lambda self, digests: None, COLLECTING),
    "membership_never_rejoins": Mutant(Membership, "must_rejoin", lambda self, now, hands: False),
    "membership_does_not_notice_that_it_was_out_of_sight": Mutant(
        Membership, "remove_coordinator", lambda self, nonce, now: None
    ),
}


def mutant(target: Any, attribute: str, **shape: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function in place of another one, which it gets as its first argument."""

    def register(replacement: Callable[..., Any]) -> Callable[..., Any]:
        original = getattr(target, attribute)

        def replaced(*given: Any, **named: Any) -> Any:
            return replacement(original, *given, **named)

        MUTANTS[replacement.__name__] = Mutant(target, attribute, replaced, shape)
        return replacement

    return register


# The coordinator: fleet, wanted jobs, member, packing.


@mutant(Leases, "release")
def fleet_forgets_to_queue_what_a_lost_worker_held(_original, self, member):
    member.leases.clear()
    member.unconfirmed.clear()


@mutant(Fleet, "_judge")
def fleet_accepts_what_it_has_accepted_already(original, self, identity, result, given, host_class):
    work = self.jobs.work(result.digest)
    works = self.__dict__.setdefault("mutated", {})
    if work is not None:
        works[result.digest] = work
    elif self.jobs.is_accepted(result.digest) and result.digest in works:
        return "accepted", works[result.digest]
    return original(self, identity, result, given, host_class)


@mutant(Fleet, "_judge")
def fleet_believes_every_result_of_the_generation_that_is_open(original, self, identity, result, given, host_class):
    if result.digest not in self.jobs and result.fitness is not None and self.jobs:
        result = msgspec.structs.replace(result, digest=next(iter(self.jobs)))
        given = self.find_job_for_result(identity, result)
    return original(self, identity, result, given, host_class)


@mutant(Fleet, "add_worker")
def fleet_keeps_the_leases_of_a_worker_that_joins_again(_original, self, identity, slots, fingerprint, now):
    numbering = next(self._numberings)
    self.members[identity] = Member(identity, slots, fingerprint, numbering, last_heard=now)
    return numbering


@mutant(Fleet, "handle_heartbeat")
def fleet_believes_beats_of_other_numberings(original, self, identity, beat, now):
    if member := self.members.get(identity):  # which then shows no more batches than were sent, or is found out
        beat = msgspec.structs.replace(beat, numbering=member.numbering, seen=min(beat.seen, member.number))
    return original(self, identity, beat, now)


@mutant(Fleet, "dispatch")
def fleet_sends_verdicts_before_they_are_durable(original, self, now, *, durable=True):
    return original(self, now, durable=True)


@mutant(PendingJobs, "add_holder")
def jobs_that_fill_the_slack_are_not_counted(_original, self, digest, worker, **_):
    self[digest].holders |= {worker}


@mutant(Fleet, "handle_result")
def fleet_gives_no_verdict_on_a_duplicate(original, self, identity, result, now, *host_class):
    judged = original(self, identity, result, now, *host_class)
    if judged[0] == "duplicate" and identity in self.members:
        self.members[identity].verdicts.pop()
    return judged


@mutant(PendingJobs, "remove")
def jobs_keep_their_tags_when_they_are_answered(original, self, digest):
    tags = dict(self._tags)
    wanted = original(self, digest)
    self._tags = tags
    return wanted


@mutant(packing, "vector_parts", **LONG)
def packing_leaves_out_a_part_of_a_long_vector(original, work):
    return [part for part in original(work) if part.offset != MAX_PART]


# The coordinator: run, generations, evaluations, uploads.


@mutant(Generation, "record")
def generation_fills_places_in_the_order_in_which_results_come(original, self, digest, fitness, steps, measures=()):
    missing = self.missing
    return original(self, missing[0].job.digest if missing else digest, fitness, steps)


@mutant(Generation, "record")
def generation_adds_to_a_place_what_has_been_counted(original, self, digest, fitness, steps, measures=()):
    (row, column), *_ = self._places[digest]
    return original(self, digest, fitness + (self._scores[row, column - 1] == fitness) + (column > 1) * 1e-9, steps)


@mutant(Generation, "_open_second_half", racing=True, episodes=3)
def generation_lets_the_worse_half_pass_the_barrier(original, self):
    self._scores *= -1
    passed = original(self)
    self._scores *= -1
    return passed


@mutant(Generation, "fitness", racing=True, episodes=3, **FAILING)
def generation_counts_what_its_race_does_not_want(_original, self):
    scored = np.isfinite(self._scores)
    means = np.where(scored, self._scores, 0.0).sum(axis=1) / np.maximum(scored.sum(axis=1), 1)
    return np.where(self._failed, np.nan, means)


@mutant(Generations, "begin", **FAILING)
def generations_forget_how_often_candidates_were_drawn_anew(original, self):
    generation = original(self)
    self._rounds = 0
    return generation


@mutant(Run, "commit")
def run_commits_only_what_closes_a_generation(original, self):
    if len(self.history) > self.__dict__.setdefault("committed", len(self.history)):
        self.committed = len(self.history)
        original(self)


@mutant(Evaluations, "open", evaluate_every=1)
def evaluations_forget_the_scores_of_the_life_before(original, self, evaluation, spec, _known):
    return original(self, evaluation, spec, {})


@mutant(Confirmation, "record", confirm_episodes=4, evaluate_every=1, ends=True)
def confirmation_fills_its_round_in_the_order_in_which_scores_come(original, self, digest, score):
    still = [each for each in self._digests if each not in self._scores]
    if digest in still:
        original(self, still[0], score)


@mutant(StageTracker, "required_evaluation", **SCORED)
def stages_begin_without_the_evaluation_that_decides(original, self, generation):
    return original(self, generation) if generation == self._generation else -1


@mutant(Generations, "_search", first_stage=1, anew=True)
def a_stage_that_is_continued_searches_as_the_first_one(original, self, stage, start):
    return original(self, stage if self.last else stages_of(self._settings)[0], start)


@mutant(Intake, "_finish", **COLLECTING)
def intake_joins_parts_in_the_order_in_which_they_come(_original, self, worker, digest, upload):
    upload.whole = b"".join(upload.parts.values())
    upload.parts.clear()


# The worker.


@mutant(Backlog, "add_batch")
def backlog_counts_a_batch_twice(original, self, batch, in_slots):
    seen, ahead = self.seen, set(self._received_ahead)
    if batch.number > seen and batch.number not in ahead:
        return original(self, batch, in_slots)
    self.seen, self._received_ahead = batch.number - 1, set()
    refused = original(self, batch, in_slots)
    self.seen, self._received_ahead = seen, ahead
    return refused


@mutant(Backlog, "add_batch")
def backlog_believes_a_digest_that_is_not_of_its_content(original, self, batch, in_slots):
    self._jobs.update({job.digest: job for job, _ in original(self, batch, in_slots)})
    return []


@mutant(Backlog, "start_numbering")
def backlog_goes_on_counting_in_a_new_life(original, self, numbering):
    if not hasattr(self, "seen"):
        original(self, numbering)
    self.numbering = numbering


@mutant(Backlog, "_assemble", **LONG)
def backlog_joins_a_long_vector_before_it_is_whole(_original, self, identity):
    vector = self._vectors.get(identity)
    return vector.content() or None if isinstance(vector, PartialVector) else vector


@mutant(Outbox, "due")
def outbox_never_repeats(original, self, now):
    self.repeat = math.inf
    return original(self, now)


@mutant(Outbox, "acknowledge")
def outbox_settles_another_result(original, self, digests):
    return original(self, [each for _, each in zip(digests, reversed(self._pending), strict=False)])


@mutant(UploadQueue, "_advance", **COLLECTING)
def uploads_forget_an_offset(original, self, each, now):
    original(self, each, now)
    if each.offset == MAX_PART:
        original(self, each, now)


@mutant(Membership, "must_rejoin")
def membership_trusts_a_silent_coordinator(original, self, now, hands):
    self._silent_since = now
    return original(self, now, hands)
