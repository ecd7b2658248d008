"""The whole system in one file: a coordinator evolves a vector, and workers score its candidates over Zenoh.

    python docs/explanation/miniature.py coordinator    # with `status` in its place: what each candidate waits for
    python docs/explanation/miniature.py worker         # in other terminals, as many as you like; kill any of them

Read `Job` first, then `Coordinator`, `Fleet` and `work`. R1 to R33 are rules of docs/reference/protocol.md. The same
seed gives a mean of the same bits, whatever is killed: a new coordinator goes on from miniature.sqlite in its folder.
"""

import argparse
import json
import os
import sqlite3
import threading
import time
from hashlib import sha256
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import msgpack
import zenoh

KEY = "dreamfleet/v0/miniature"  # protocol version and run
CREDIT, BEAT, LEASE = 2, 0.2, 1.0  # jobs of a worker (R14); seconds between beats, and of a lease that no beat shows


class Job(NamedTuple):
    """One episode of a candidate."""

    generation: int
    candidate: int
    vector: list[float]

    @property
    def digest(self) -> str:
        """R1: content names a job. So a result is the same from any worker, and still fits after a restart."""
        return sha256(repr(("sphere", *self)).encode()).hexdigest()


class Fleet:
    """Which worker holds which job. Pure: events and a clock in, jobs out."""

    def __init__(self) -> None:
        self.jobs: dict[str, Job] = {}  # by digest: the wanted ones, which have no result yet
        self.leases: dict[str, tuple[str, float]] = {}  # by digest: worker and deadline

    def handle_heartbeat(self, worker: str, held: list[str], now: float) -> list[Job]:
        """Renew the leases that a worker shows (R20), and lease it more jobs. R3: one whose lease ended is free."""
        own = worker, now + LEASE
        leases = self.leases | {digest: own for digest in held if self.leases.get(digest, own)[0] == worker}
        live = {digest: lease for digest, lease in leases.items() if digest in self.jobs and lease[1] >= now}
        credit = max(0, CREDIT - sum(worker == holder for holder, _ in live.values()))
        given = [job for digest, job in self.jobs.items() if digest not in live][:credit]
        self.leases = live | {job.digest: own for job in given}
        return given


class Coordinator:
    """The owner of a run: one thread handles, commits and replies, turn by turn."""

    def __init__(self, session: zenoh.Session) -> None:
        self.fleet, self.session, self.status = Fleet(), session, "{}"
        self.inbox: SimpleQueue[bytes] = SimpleQueue()  # Zenoh's threads only fill it
        self.journal = sqlite3.connect("miniature.sqlite")
        self.journal.execute("CREATE TABLE IF NOT EXISTS result (digest TEXT PRIMARY KEY, fitness REAL)")
        self.fitness = dict[str, float](self.journal.execute("SELECT digest, fitness FROM result"))
        session.declare_subscriber(f"{KEY}/beat/*/*", lambda sample: self.inbox.put(sample.payload.to_bytes()))
        session.declare_queryable(f"{KEY}/status", lambda query: query.reply(query.key_expr, self.status))

    def evolve(self, seed: int) -> None:
        """Search with CMA-ES. It learns the fitness in the candidates' order, so no worker's speed changes a bit."""
        import cma  # seconds, and the one process that searches needs it

        strategy = cma.CMAEvolutionStrategy([0.0] * 8, 0.5, {"popsize": 8, "seed": 1 + seed, "verbose": -9})
        for generation in range(30):
            vectors = strategy.ask()
            jobs = [Job(generation, candidate, vector.tolist()) for candidate, vector in enumerate(vectors)]
            self.fleet.jobs = {job.digest: job for job in jobs if job.digest not in self.fitness}
            while self.fleet.jobs:
                self.turn(jobs, *msgpack.unpackb(self.inbox.get()))
            strategy.tell(vectors, [-self.fitness[job.digest] for job in jobs])
            print(f"generation {generation}: step size {strategy.sigma:.3g}", flush=True)
        self.session.put(f"{KEY}/job/*/*", msgpack.packb({"ended": True}))
        print("mean", *map(float.hex, strategy.mean.tolist()))

    def turn(self, jobs: list[Job], worker: str, held: list[str], results: dict[str, float]) -> None:
        """Handle a heartbeat: commit its results, and only then reply (R6). R4: the first result of a job counts."""
        accepted = {digest: fitness for digest, fitness in results.items() if self.fleet.jobs.pop(digest, None)}
        self.journal.executemany("INSERT INTO result VALUES (?, ?)", accepted.items())
        self.journal.commit()
        self.fitness |= accepted
        given = self.fleet.handle_heartbeat(worker, held, time.monotonic())
        if results or given:
            verdicts = {digest: "accepted" if digest in accepted else "duplicate" for digest in results}
            self.session.put(f"{KEY}/job/{worker}", msgpack.packb({"verdicts": verdicts, "jobs": given}))
        states = [self.fitness.get(job.digest, self.fleet.leases.get(job.digest, ("queued",))[0]) for job in jobs]
        self.status = json.dumps({"generation": jobs[0].generation, "candidates": states})


def work(session: zenoh.Session, seconds: float) -> None:
    """Be a worker until the run ends. R7: each heartbeat repeats the results in the outbox, until their verdicts."""
    identity = f"{os.uname().nodename}/{os.urandom(4).hex()}"  # name and process
    inbox: SimpleQueue[bytes] = SimpleQueue()
    session.declare_subscriber(f"{KEY}/job/{identity}", lambda sample: inbox.put(sample.payload.to_bytes()))
    held, outbox, batch = set[str](), dict[str, float](), dict[str, Any]()
    while not batch.get("ended"):
        session.put(f"{KEY}/beat/{identity}", msgpack.packb((identity, [*held], outbox)))
        try:
            batch = msgpack.unpackb(inbox.get(timeout=BEAT))
        except Empty:
            continue
        outbox |= batch.get("scored", {})
        for digest in batch.get("verdicts", ()):
            held.discard(digest)
            outbox.pop(digest, None)
        for job in (Job(*fields) for fields in batch.get("jobs", ())):
            if job.digest not in held:
                held.add(job.digest)
                threading.Thread(target=score, args=(job, seconds, inbox), daemon=True).start()


def score(job: Job, seconds: float, inbox: SimpleQueue[bytes]) -> None:
    """A slot: play an episode of `seconds`. Its fitness is minus the squared distance from (1, 1, ...)."""
    print(f"scores candidate {job.candidate} of generation {job.generation}\n", end="", flush=True)  # a line as a whole
    time.sleep(seconds)
    inbox.put(msgpack.packb({"scored": {job.digest: -sum((x - 1) ** 2 for x in job.vector)}}))


def main() -> None:
    """Be a coordinator or a worker, or print the status."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("role", choices=("coordinator", "worker", "status"))
    parser.add_argument("--endpoint", default="tcp/127.0.0.1:7448", help="where the coordinator listens")
    parser.add_argument("--seed", type=int, default=0, help="of the search")
    parser.add_argument("--seconds", type=float, default=0.05, help="that a worker takes for an episode")
    args = parser.parse_args()
    mode, side = ("router", "listen") if args.role == "coordinator" else ("client", "connect")
    ends = {"endpoints": [args.endpoint], "timeout_ms": {"router": 0, "client": -1}}  # a worker waits for it
    config = {"mode": mode, side: ends, "scouting": {"multicast": {"enabled": False}}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        if args.role == "coordinator":
            Coordinator(session).evolve(args.seed)
        elif args.role == "worker":
            work(session, args.seconds)
        else:
            print(*(reply.ok.payload.to_string() for reply in session.get(f"{KEY}/status") if reply.ok))


if __name__ == "__main__":
    main()
