"""A fleet of two workers and its jobs, without a run."""

import numpy as np
from msgspec.structs import replace

from dreamfleet.common.protocol.messages import TAG_BYTES, Heartbeat, Result, RunningJob
from dreamfleet.coordinator.dispatch.fleet import Fleet as _Fleet
from dreamfleet.coordinator.jobs.scoring_job import make_jobs, vector_bytes
from tests.support.samples import HEAD, SPEC


class Fleet(_Fleet):
    """A heartbeat without a numbering gets that of its worker's welcome."""

    def handle_heartbeat(self, identity, beat, now):
        member = self.members.get(identity)
        super().handle_heartbeat(
            identity, replace(beat, numbering=beat.numbering or (member.numbering if member else 0)), now
        )


A, B = "a/00000001", "b/00000002"

BEAT = 1.0


def work(count, kind="score", generation=0):
    vector = vector_bytes(np.arange(4.0) + generation)
    return make_jobs(SPEC, kind, generation, 0, vector, range(1000, 1000 + count))


def beat(capacity=1, seen=0, numbering=0, queued=(), running=(), unacked=(), rate=0.0, steps=5, reason=""):
    return Heartbeat(
        **HEAD, nonce="n", numbering=numbering, seen=seen, capacity=capacity, slots=capacity, load=0.0,
        steps_per_second=rate, drawn_by="-", reason=reason,
        queued=tuple(digest[:TAG_BYTES] for digest in queued),
        running=tuple(RunningJob(digest[:TAG_BYTES], steps) for digest in running),
        unacked=tuple(digest[:TAG_BYTES] for digest in unacked),
    )  # fmt: skip


def result(digest, fitness=1.0, error=None, steps=10):
    return Result(digest, None if error else fitness, steps, 0.1, error, None)


def fleet_of(*names, capacity=1, jobs=10):
    fleet = Fleet(BEAT)
    fleet.jobs.offer(work(jobs))
    for name in names:
        join(fleet, name, 0.0, capacity)
    return fleet


def join(fleet, name, now, capacity=1):
    fleet.add_worker(name, capacity, "f", now)
    fleet.handle_heartbeat(name, beat(capacity), now)


def digests(sends, name):
    return [each.job.digest for send in sends if send.identity == name for each in send.work]
