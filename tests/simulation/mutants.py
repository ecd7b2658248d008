"""Faults that are planted in the pure parts, one rule each: a simulation that does not find them proves nothing.

Each mutant replaces one function by one that forgets a rule. `shape` turns the drawn schedules to where the rule
matters, for rules that few shapes exercise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
    shape: Mapping[str, Any]

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


MUTANTS: dict[str, Mutant] = {}
FOUND = [Schedule.from_json(line) for line in Path(__file__).with_name("found.jsonl").read_text().splitlines()]
COLLECTING = {"collect_every": 1, "rollout": 90_000}
SCORED = {"evaluate_every": 1, "first_stage": 3, "first_score": 1.2, "generations": 3}
FAILING = {"on_failure": "redraw", "failing": 0.15}
LONG = {"parameters": 23_000, "width": 1}


def mutant(target: Any, attribute: str, **shape: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function that takes what it replaces, and gives the replacement."""

    def register(make: Callable[..., Any]) -> Callable[..., Any]:
        original = getattr(target, attribute)
        MUTANTS[make.__name__] = Mutant(target, attribute, make(original), shape)
        return make

    return register


# The coordinator: checks of results. Mutants of a recall are in `test_liars.py`.


@mutant(Check, "may_ask", verify=1.0)
def checks_ask_the_host_that_answered(_original):
    return lambda self, host, host_class: True


@mutant(Verification, "settle", verify=1.0, workers=1)
def checks_wait_for_hosts_that_are_not_there(_original):
    return lambda self, now: None


@mutant(Verification, "restore", verify=1.0)
def checks_are_forgotten_in_a_restart(_original):
    return lambda self, work: None


@mutant(BackgroundJobs, "_check_again", verify=1.0, confirm_episodes=4, evaluate_every=1, ends=True)
def checks_of_a_confirmation_are_forgotten_in_a_restart(_original):
    return lambda self, work: False


@mutant(Verification, "holds_generation", verify=1.0)
def generations_do_not_wait_for_their_checks(_original):
    return False


# The coordinator: fleet, wanted jobs, member, packing.


@mutant(Leases, "release")
def fleet_forgets_to_queue_what_a_lost_worker_held(_original):
    def release(self, member):
        member.leases.clear()
        member.unconfirmed.clear()

    return release


@mutant(Fleet, "_judge")
def fleet_accepts_what_it_has_accepted_already(original):
    def judge(self, identity, result, given, host_class):
        work = self.jobs.work(result.digest)
        works = self.__dict__.setdefault("mutated", {})
        if work is not None:
            works[result.digest] = work
        elif self.jobs.is_accepted(result.digest) and result.digest in works:
            return "accepted", works[result.digest]
        return original(self, identity, result, given, host_class)

    return judge


@mutant(Fleet, "_judge")
def fleet_believes_every_result_of_the_generation_that_is_open(original):
    def judge(self, identity, result, given, host_class):
        if result.digest not in self.jobs and result.fitness is not None and self.jobs:
            result = msgspec.structs.replace(result, digest=next(iter(self.jobs)))
            given = self.find_job_for_result(identity, result)
        return original(self, identity, result, given, host_class)

    return judge


@mutant(Member, "take_overdue_batches")
def fleet_never_sends_a_batch_again(_original):
    return lambda self, now, patience: iter(())


@mutant(member, "ABSENT_HEARTBEATS")
def fleet_never_misses_a_job_that_beats_do_not_show(_original):
    return 10**9


@mutant(Fleet, "add_worker")
def fleet_keeps_the_leases_of_a_worker_that_joins_again(_original):
    def add_worker(self, identity, slots, fingerprint, now):
        numbering = next(self._numberings)
        self.members[identity] = Member(identity, slots, fingerprint, numbering, last_heard=now)
        return numbering

    return add_worker


@mutant(Fleet, "handle_heartbeat")
def fleet_believes_beats_of_other_numberings(original):
    def beat(self, identity, beat, now):
        if member := self.members.get(identity):  # which then shows no more batches than were sent, or is found out
            beat = msgspec.structs.replace(beat, numbering=member.numbering, seen=min(beat.seen, member.number))
        return original(self, identity, beat, now)

    return beat


@mutant(Fleet, "find_job_for_result")
def fleet_asks_for_results_of_nobody(_original):
    return lambda self, identity, result: None


@mutant(Member, "start_numbering")
def member_counts_on_after_a_silence(_original):
    return lambda self, numbering: None


@mutant(Fleet, "dispatch")
def fleet_sends_verdicts_before_they_are_durable(original):
    return lambda self, now, *, durable=True: original(self, now, durable=True)


@mutant(PendingJobs, "add_holder")
def jobs_that_fill_the_slack_are_not_counted(_original):
    def add_holder(self, digest, worker, **_):
        self[digest].holders |= {worker}

    return add_holder


@mutant(Fleet, "handle_result")
def fleet_gives_no_verdict_on_a_duplicate(original):
    def result(self, identity, result, now, *host_class):
        judged = original(self, identity, result, now, *host_class)
        if judged[0] == "duplicate" and identity in self.members:
            self.members[identity].verdicts.pop()
        return judged

    return result


@mutant(PendingJobs, "begin_generation")
def jobs_remember_every_acceptance(_original):
    return lambda self, generation: None


@mutant(PendingJobs, "clear_failures")
def jobs_keep_their_failures_when_the_run_is_resumed(_original):
    return lambda self: None


@mutant(PendingJobs, "remove")
def jobs_keep_their_tags_when_they_are_answered(original):
    def remove(self, digest):
        tags = dict(self._tags)
        wanted = original(self, digest)
        self._tags = tags
        return wanted

    return remove


@mutant(Member, "credit")
def member_has_credit_whatever_it_holds(_original):
    return property(lambda self: 2 * self.capacity if self.is_reachable else 0)


@mutant(packing, "vector_parts", **LONG)
def packing_leaves_out_a_part_of_a_long_vector(original):
    return lambda work: [part for part in original(work) if part.offset != MAX_PART]


# The coordinator: run, generations, evaluations, uploads.


@mutant(Generation, "record")
def generation_fills_places_in_the_order_in_which_results_come(original):
    def record(self, digest, fitness, steps, measures=()):
        missing = self.missing
        return original(self, missing[0].job.digest if missing else digest, fitness, steps)

    return record


@mutant(Generation, "record")
def generation_adds_to_a_place_what_has_been_counted(original):
    def record(self, digest, fitness, steps, measures=()):
        (row, column), *_ = self._places[digest]
        return original(self, digest, fitness + (self._scores[row, column - 1] == fitness) + (column > 1) * 1e-9, steps)

    return record


@mutant(Generation, "_open_second_half", racing=True, episodes=3)
def generation_lets_the_worse_half_pass_the_barrier(original):
    def barrier(self):
        self._scores *= -1
        passed = original(self)
        self._scores *= -1
        return passed

    return barrier


@mutant(Generation, "fitness", racing=True, episodes=3, **FAILING)
def generation_counts_what_its_race_does_not_want(_original):
    def fitness(self):
        scored = np.isfinite(self._scores)
        means = np.where(scored, self._scores, 0.0).sum(axis=1) / np.maximum(scored.sum(axis=1), 1)
        return np.where(self._failed, np.nan, means)

    return fitness


@mutant(Generations, "_recall")
def generations_forget_the_results_of_the_life_before(_original):
    return lambda self, stored, terms: self._generation(stored.number, stored.vectors, stored.seeds, terms)


@mutant(Generations, "begin", **FAILING)
def generations_forget_how_often_candidates_were_drawn_anew(original):
    def begin(self):
        generation = original(self)
        self._rounds = 0
        return generation

    return begin


@mutant(generations, "_ranked", **FAILING)
def generations_rank_failed_candidates_above_the_worst(_original):
    return lambda fitness, worst: np.where(np.isfinite(fitness), fitness, worst + 0.5)


@mutant(failure_judge, "is_lasting", **FAILING)
def failures_become_facts_after_one_attempt(_original):
    return lambda attempts, working, present: True


@mutant(Run, "commit")
def run_commits_only_what_closes_a_generation(original):
    def commit(self):
        if len(self.history) > self.__dict__.setdefault("committed", len(self.history)):
            self.committed = len(self.history)
            original(self)

    return commit


@mutant(Evaluations, "open", evaluate_every=1)
def evaluations_forget_the_scores_of_the_life_before(original):
    return lambda self, evaluation, spec, _known: original(self, evaluation, spec, {})


@mutant(Confirmation, "record", confirm_episodes=4, evaluate_every=1, ends=True)
def confirmation_fills_its_round_in_the_order_in_which_scores_come(original):
    def record(self, digest, score):
        still = [each for each in self._digests if each not in self._scores]
        if digest in still:
            original(self, still[0], score)

    return record


@mutant(StageTracker, "required_evaluation", **SCORED)
def stages_begin_without_the_evaluation_that_decides(original):
    def required_evaluation(self, generation):
        return original(self, generation) if generation == self._generation else -1

    return required_evaluation


@mutant(Generations, "_search", first_stage=1, anew=True)
def a_stage_that_is_continued_searches_as_the_first_one(original):
    def search(self, stage, start):
        return original(self, stage if self.last else stages_of(self._settings)[0], start)

    return search


@mutant(RolloutCollections, "receive", **COLLECTING)
def collections_accept_a_rollout_that_has_not_come(_original):
    return lambda self, _worker, result, _work: result


@mutant(Intake, "_finish", **COLLECTING)
def intake_joins_parts_in_the_order_in_which_they_come(_original):
    def finish(self, worker, digest, upload):
        upload.whole = b"".join(upload.parts.values())
        upload.parts.clear()

    return finish


@mutant(Intake, "forget", **COLLECTING)
def intake_never_lets_go_of_a_file(_original):
    return lambda self, digest: None


# The worker.


@mutant(Backlog, "add_batch")
def backlog_counts_a_batch_twice(original):
    def add_batch(self, batch, in_slots):
        seen, ahead = self.seen, set(self._received_ahead)
        if batch.number > seen and batch.number not in ahead:
            return original(self, batch, in_slots)
        self.seen, self._received_ahead = batch.number - 1, set()
        refused = original(self, batch, in_slots)
        self.seen, self._received_ahead = seen, ahead
        return refused

    return add_batch


@mutant(Backlog, "add_batch")
def backlog_believes_a_digest_that_is_not_of_its_content(original):
    def add_batch(self, batch, in_slots):
        self._jobs.update({job.digest: job for job, _ in original(self, batch, in_slots)})
        return []

    return add_batch


@mutant(Backlog, "start_numbering")
def backlog_goes_on_counting_in_a_new_life(original):
    def start_numbering(self, numbering):
        if not hasattr(self, "seen"):
            original(self, numbering)
        self.numbering = numbering

    return start_numbering


@mutant(Backlog, "_assemble", **LONG)
def backlog_joins_a_long_vector_before_it_is_whole(_original):
    def whole(self, identity):
        vector = self._vectors.get(identity)
        return vector.content() or None if isinstance(vector, PartialVector) else vector

    return whole


@mutant(Outbox, "due")
def outbox_never_repeats(original):
    def due(self, now):
        self.repeat = math.inf
        return original(self, now)

    return due


@mutant(Outbox, "acknowledge")
def outbox_settles_another_result(original):
    return lambda self, digests: original(
        self, [each for _, each in zip(digests, reversed(self._pending), strict=False)]
    )


@mutant(Outbox, "acknowledge")
def outbox_ignores_verdicts(_original):
    return lambda self, digests: None


@mutant(UploadQueue, "_advance", **COLLECTING)
def uploads_forget_an_offset(original):
    def advance(self, each, now):
        original(self, each, now)
        if each.offset == MAX_PART:
            original(self, each, now)

    return advance


@mutant(UploadQueue, "acknowledge", **COLLECTING)
def uploads_go_on_after_the_verdict(_original):
    return lambda self, digests: None


@mutant(Membership, "must_rejoin")
def membership_never_rejoins(_original):
    return lambda self, now, hands: False


@mutant(Membership, "must_rejoin")
def membership_trusts_a_silent_coordinator(original):
    def must_rejoin(self, now, hands):
        self._silent_since = now
        return original(self, now, hands)

    return must_rejoin


@mutant(Membership, "remove_coordinator")
def membership_does_not_notice_that_it_was_out_of_sight(_original):
    return lambda self, nonce, now: None
