"""A sample of each message, for golden files and mutations."""

import hashlib

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.client.status import (
    EpisodeProgress,
    FailureStatus,
    GenerationStatus,
    Population,
    Status,
    Throughput,
    Waste,
    WorkerCount,
    WorkerStatus,
)
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import (
    BundlePart,
    ClaimNote,
    ControlReply,
    GenerationEvent,
    Heartbeat,
    HelloReply,
    HelloRequest,
    Intervals,
    Job,
    JobBatch,
    Result,
    ResultBatch,
    RunningJob,
    TaskSpec,
    UploadPart,
    VectorPart,
    Verdict,
    ViewFrame,
)
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration

UID = "0123456789abcdef" * 2
SPEC = TaskSpec(task="car-racing", bundle="ab" * 32, horizon=1000, patience=100)
VECTOR = bytes(range(64))
VECTOR_ID = hashlib.sha256(VECTOR).digest()
VERDICTS = ("accepted", "duplicate", "obsolete", "refused")
HEAD = {"run_uid": UID, "incarnation": 3}


def job(episode=0, kind="score", candidate=2, spec=SPEC, seed=1048576, **named):
    digest = spec.with_overrides(**named).digest(kind, VECTOR_ID, (seed + episode,))
    return Job(
        kind=kind, task=spec.task, generation=7, candidate=candidate, episode=episode, seeds=(seed + episode,),
        vector=VECTOR_ID, digest=digest, stall=30.0, **named,
    )  # fmt: skip


WHOLE = VectorPart(id=VECTOR_ID, dtype="<f4", shape=(16,), offset=0, data=VECTOR)


def batch(number, jobs=(), vectors=(WHOLE,), cancels=()):
    return JobBatch(
        **HEAD, nonce="n", numbering=0, number=number, vectors=vectors, jobs=tuple(jobs), cancels=cancels, verdicts=()
    )


NONCE = "c0ffee00c0ffee00"
BEAT = {**HEAD, "nonce": NONCE, "numbering": 3, "seen": 9, "capacity": 4, "slots": 4, "load": 1.5,
        "steps_per_second": 987.5, "drawn_by": "native"}  # fmt: skip
WELCOME = (
    "0.1.0", "night", UID, 3, NONCE, "", "",
    {"task": "car-racing", "bundle": "ab" * 32, "horizon": 1000, "patience": 100}, {"beat": 1.0, "repeat": 1.0},
)  # fmt: skip
MSGPACK = {
    "job": JobBatch(
        **HEAD, nonce="c0ffee00c0ffee00", numbering=3, number=9, vectors=(WHOLE,),
        jobs=(job(), job(1), job(0, "evaluate"), job(0, "collect")), cancels=(b"\x05" * 32,),
        verdicts=tuple(Verdict(bytes([n]) * 32, word) for n, word in enumerate(VERDICTS)),
    ),
    "job-staged": JobBatch(
        **HEAD, nonce="c0ffee00c0ffee00", numbering=3, number=11, vectors=(),
        jobs=(job(horizon=400, patience=60), job(horizon=400), job(patience=0)), cancels=(), verdicts=(),
    ),
    "result": ResultBatch(
        **HEAD, fingerprint="x86_64 avx2 glibc-2.36 numpy-2.4.6",
        results=(
            Result(b"\x01" * 32, 812.5, 1000, 7.25, None, None),
            Result(b"\x02" * 32, None, 17, 0.5, Failure("slot crashed (signal 11)", "signal 11", "crash"), None),
            Result(b"\x03" * 32, 0.0, 300, 2.0, None, b"\x04" * 32),
        ),
    ),
    "result-classed": ResultBatch(
        **HEAD, fingerprint="x86_64 avx2", results=(Result(b"\x01" * 32, 812.5, 1000, 7.25, None, None),),
        host_class="0123456789abcdef",
    ),
    "beat-classed": Heartbeat(**BEAT, queued=(), running=(), unacked=(), host_class="0123456789abcdef"),
    "beat": Heartbeat(
        **BEAT, queued=(b"abcdefgh",), running=(RunningJob(b"ABCDEFGH", 412),), unacked=(b"12345678",)
    ),
    "bundle": BundlePart(**HEAD, sha256=b"\xab" * 32, offset=40960, total=14302154, data=b"part of a bundle"),
    "upload": UploadPart(
        **HEAD, digest=b"\x01" * 32, sha256=b"\x04" * 32, offset=0, total=16, data=b"part of a drive!"
    ),
    "view": ViewFrame(**HEAD, slot=1, tag=b"ABCDEFGH", step=99, reward=-0.1, height=2, width=2, picture=bytes(12)),
    "view-whole": ViewFrame(
        **HEAD, slot=1, tag=b"ABCDEFGH", step=99, reward=-0.1, height=2, width=2, packed=True,
        picture=bytes.fromhex("789c6360400000000c0001"), kind="evaluate", generation=7, candidate=2, seed=20003,
        action=(0.25, 1.0, 0.0), latent=bytes(8), state=bytes(16), parameters=VECTOR,
    ),
}  # fmt: skip
JSON = {
    "hello-request": HelloRequest(1, 1, "0.1.0", "host-a/0a1b2c3d", ("car-racing", "dream"), "x86_64 avx2", 8),
    "hello-reply": HelloReply(True, 1, 1, *WELCOME),
    "hello-reply-numbered": HelloReply(True, 2, 2, *WELCOME, numbering=4),
    "hello-request-classed": HelloRequest(
        2, 2, "0.1.0", "host-a/0a1b2c3d", ("car-racing", "dream"), "x86_64 avx2", 8, host_class="0123456789abcdef"
    ),
    "generation-event": GenerationEvent(
        v=1, run="night", run_uid=UID, incarnation=3, generation=7, mean=100.5, std=20.25, best=150.0, worst=-10.0,
        sigma=0.09, seconds=12.5, environment_steps=64000,
    ),
    "control-reply": ControlReply(v=1, run="night", accepted=True, why=""),
    "control-reply-left": ControlReply(v=1, run="night", accepted=True, why="", again="dreamfleet coordinator ..."),
    "claim": ClaimNote(run_uid=UID, incarnation=3, nonce="c0ffee00c0ffee00", began=1.7e9),
    "intervals": Intervals(beat=1.0, repeat=1.0),
    "task-spec": SPEC,
}  # fmt: skip

CLOSED = StoredGeneration(6, 90.5, 20.25, 140.0, -12.5, 0.095, 64000, 12.5)
BEST = StoredEvaluation(4, 16, 120.5, 30.25)
STATUS = Status(
    schema=2, run="night", run_uid=UID, incarnation=3, package="0.1.0", state="running", why="",
    settings=RunSettings(SPEC, ControllerShape(288, 3), 4, 2, 0.1, "diagonal", 1, 5, 16), limits={"generations": 100},
    uptime=99.5, generation=GenerationStatus(3, 8, 7, 2.5, 0.09, None), generations=7, last=CLOSED, recent=(CLOSED,),
    population=Population(7, 0, 4, (2, 1, 0, 0), (2, 2, 2, 2), (101.5, -3.25, None, None)),
    last_population=Population(6, 0, 4, (2, 2, 2, 2), (2, 2, 2, 2), (140.0, 112.0, 122.5, -12.5)),
    evaluation=BEST, best=BEST, evaluations=1, evaluating=EpisodeProgress(0, 0), collecting=EpisodeProgress(8, 8),
    workers=WorkerCount(1, 1, 0),
    worker_list=(WorkerStatus("host-a/0a1b2c3d", "present", 8, 12, 400, 987.5, 1.5, "native", 0.3, "x86_64 avx2"),),
    slots=8, fingerprint="x86_64 avx2", throughput=Throughput(987.5, 448000, 0.0),
    waste=Waste(100, 0.01, 1, 2, 3, 4, 5, 6, 7, 8), failing=1,
    failures=(FailureStatus("7/1", "score", (1048576,), {"host-a/0a1b2c3d": "boom"}, {"host-a/0a1b2c3d": 2}),),
    dropped={"not msgpack": 2},
)  # fmt: skip
