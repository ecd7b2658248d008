"""All messages of protocol version 2, frozen: structs in msgpack, dataclasses in JSON.

The annotations are the schema, which msgspec checks. A message has at most `MAX_MESSAGE` bytes; larger batches are
split, and long vectors and files are sent in parts. Pages: share-a-fleet.md, tasks.md, threats.md, operations-notes.md.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.measures import MeasureNames, Measures
from dreamfleet.common.schema.display import DisplayedFields
from dreamfleet.common.schema.validation import OPTIONAL, Count, Digest, Finite, Packed, Seconds, Text, Word, to_plain

MAX_MESSAGE = 48 * 1024
MAX_PART = 40 * 1024  # leaves room for the rest of the message
MAX_PICTURE_SIDE = 256  # pixels of a live frame's picture
MAX_UPLOAD = 32 << 20  # a rollout of 1000 steps has 12 MB (64x64) or 28 MB (96x96) uncompressed
MAX_OPTIONS = 8_000  # characters; statuses and controllers contain them too
MAX_END = 32  # characters of an end rule
MAX_REASON = 400  # characters of why a worker leaves, or a run has ended
MAX_LEASES = 1024  # of one worker; a heartbeat lists them all and must stay under MAX_MESSAGE
MAX_SIDE_BY_SIDE = 8  # candidates' drives that a slot does side by side
MAX_BATCHES = 2**53  # never reached
MAX_SLOTS = 4096  # of one worker
TAG_BYTES = 8
MIN_TEMPERATURE, MAX_TEMPERATURE = 1e-3, 1e3  # of a dream
OWN_END_VERSION = 10  # added to the world's version by runs with an end rule of their own

# The first bytes of a digest, unique among one worker's jobs
Tag = Annotated[bytes, Meta(min_length=TAG_BYTES, max_length=TAG_BYTES)]
Part = Annotated[bytes, Meta(max_length=MAX_PART)]
Temperature = Annotated[float, Meta(ge=MIN_TEMPERATURE, le=MAX_TEMPERATURE)]
Horizon = Annotated[int, Meta(ge=1, le=10**6)]  # maximum steps of an episode that is scored for the optimiser
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
MIN_SHARE, MAX_SHARE = 0.01, 100.0
# Of a fleet's slots, relative to the other runs' shares
FleetShare = Annotated[float, Meta(ge=MIN_SHARE, le=MAX_SHARE)]
Patience = Annotated[int, Meta(ge=0, le=10**6)]  # steps without reward after which a scored episode ends; 0: never
Packages = Annotated[tuple[Word, ...], Meta(max_length=64)]
# Why a worker leaves, or why a run has ended; empty: nothing is said
Reason = Annotated[str, Meta(max_length=MAX_REASON)]
HostClass = Annotated[str, Meta(max_length=32)]  # see `host_classes`; empty: not known yet
Kind = Literal["score", "evaluate", "collect"]
VerdictWord = Literal["accepted", "duplicate", "obsolete", "refused"]


@dataclass(frozen=True, repr=False)
class TaskSpec(DisplayedFields):
    """The task that candidates are scored in, frozen with a run.

    A fitness is a function of this specification, the parameters and the seeds alone.

    >>> from dreamfleet import TaskSpec, find_bundle
    >>> spec = TaskSpec("car-racing", find_bundle("tiny").sha256, horizon=1000, patience=100)
    >>> spec.with_overrides(horizon=200).horizon
    200
    >>> TaskSpec("gym:CartPole-v1", "", horizon=500, patience=0)
    TaskSpec(task='gym:CartPole-v1', bundle='', horizon=500, patience=0)
    """

    task: Word
    bundle: Annotated[str, Meta(max_length=64)]  # SHA-256 of the bundle's file, hexadecimal; empty without one
    horizon: Horizon
    patience: Patience
    controller: ControllerShape | None = field(default=None, metadata=OPTIONAL)  # `None`: linear on z and h
    temperature: Temperature | None = field(default=None, metadata=OPTIONAL)  # of a dream
    # The task's options, as canonical JSON, such as arguments of its environment.
    options: Annotated[str, Meta(max_length=MAX_OPTIONS)] = field(default="", metadata=OPTIONAL)
    # Version of the task: another one computes another fitness.
    version: Annotated[int, Meta(ge=1, le=10**6)] = field(default=1, metadata=OPTIONAL)
    recorded: Share = field(default=0.0, metadata=OPTIONAL)  # share of dreams that begin at recorded states
    driven: bool = field(default=False, metadata=OPTIONAL)  # score a dream task in the real environment
    # When dreams end, in place of the bundle's own rule: a text that `EndRule.parse` reads. Empty: the bundle's own.
    end: Annotated[str, Meta(max_length=MAX_END)] = field(default="", metadata=OPTIONAL)
    measures: MeasureNames = field(default=(), metadata=OPTIONAL)  # that each episode gives beside its fitness

    @property
    def world_version(self) -> int:
        """Version of the world that is scored in, which controllers keep: `version` without `OWN_END_VERSION`."""
        return self.version - OWN_END_VERSION if self.end else self.version

    def option(self, name: str, default: Any = None) -> Any:
        """The value of one of the task's options."""
        return json.loads(self.options or "{}").get(name, default)

    def with_overrides(
        self, horizon: int | None = None, patience: int | None = None, driven: bool | None = None
    ) -> TaskSpec:
        """This specification with other values; `None` leaves a value as it is."""
        named = {"horizon": horizon, "patience": patience, "driven": driven}
        others: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
        return replace(self, **others) if others else self

    def digest(self, kind: Kind, vector: bytes, seeds: tuple[int, ...]) -> bytes:
        """The identity of a job: SHA-256 of its kind, this specification, the parameters' hash and the seeds."""
        return hashlib.sha256(vector + self.digest_text(kind, seeds)).digest()

    def digest_text(self, kind: Kind, seeds: tuple[int, ...]) -> bytes:
        """What a job's identity hashes behind the parameters' hash."""
        return f'{{"kind": "{kind}", "seeds": {list(seeds)}, "spec": {self._json}}}'.encode()

    @cached_property
    def _json(self) -> str:
        return json.dumps(to_plain(self), sort_keys=True)


class Message(Packed, frozen=True, kw_only=True):
    """Fields of every message; the codec adds the protocol version."""

    SCHEMA: ClassVar[str]

    run_uid: Annotated[str, Meta(min_length=32, max_length=32)]
    incarnation: Count


class VectorPart(Packed, frozen=True):
    """Bytes from `offset` of an array of little-endian `dtype` and `shape` whose SHA-256 is `id`."""

    id: Digest
    dtype: Literal["<f4", "<f8"]
    shape: Annotated[tuple[Count, ...], Meta(min_length=1, max_length=4)]
    offset: Count
    data: Part


class Job(Packed, frozen=True):
    """One episode of a candidate, or of the mean (`evaluate`, `collect`): the unit of dispatch."""

    kind: Kind
    task: Word
    generation: Count
    candidate: Count
    episode: Count
    seeds: Annotated[tuple[Count, ...], Meta(min_length=1, max_length=64)]
    vector: Digest
    digest: Digest
    stall: Seconds  # a slot without a step for so long is hung
    # Overrides of the specification; `None`: none.
    horizon: Horizon | None = None
    patience: Patience | None = None
    driven: bool | None = None

    @property
    def overrides(self) -> tuple[int | None, int | None, bool | None]:
        """The overrides, in the order of `TaskSpec.with_overrides`."""
        return self.horizon, self.patience, self.driven

    @property
    def is_background(self) -> bool:
        """Whether a slot runs this job alone; candidates' jobs may share one."""
        return self.kind != "score"

    def spec(self, run_spec: TaskSpec) -> TaskSpec:
        """The run's specification with this job's overrides."""
        return run_spec.with_overrides(*self.overrides)


class Verdict(Packed, frozen=True):
    """The coordinator's decision on a result; the worker stops repeating that result."""

    digest: Digest
    verdict: VerdictWord


class JobBatch(Message, frozen=True, kw_only=True):
    """Coordinator to one worker; `number` counts from 1 without gaps in each `numbering`."""

    SCHEMA: ClassVar[str] = "job"

    nonce: Word
    numbering: Count
    number: Count
    vectors: tuple[VectorPart, ...]
    jobs: tuple[Job, ...]
    cancels: tuple[Digest, ...]
    verdicts: tuple[Verdict, ...]
    leave: bool = False  # the run is over: the worker exits
    ended: bool = False  # the run has ended: the worker leaves it
    why: Reason = ""  # it ended


class Result(Packed, frozen=True):
    """A finished job: a fitness or an error; a collected rollout also has the hash of its upload."""

    digest: Digest
    fitness: Finite | None
    steps: Count
    seconds: Seconds
    error: Failure | None
    upload: Digest | None
    measures: Measures = ()  # those that the specification names, in its order


class ResultBatch(Message, frozen=True, kw_only=True):
    """One worker to the coordinator; each result is repeated until its verdict arrives."""

    SCHEMA: ClassVar[str] = "result"

    fingerprint: Text
    results: tuple[Result, ...]
    host_class: HostClass = ""  # of the worker's host


class RunningJob(Packed, frozen=True):
    """A job in a slot, and its environment steps so far."""

    tag: Tag
    steps: Count


class Heartbeat(Message, frozen=True, kw_only=True):
    """One worker to the coordinator, periodically: its jobs and load."""

    SCHEMA: ClassVar[str] = "beat"

    nonce: Word
    numbering: Count
    seen: Annotated[int, Meta(ge=0, le=MAX_BATCHES)]  # all batches of this numbering up to this number have arrived
    capacity: Annotated[int, Meta(ge=0, le=MAX_LEASES)]  # slots times the jobs that the task batches in one
    slots: Annotated[int, Meta(ge=0, le=MAX_SLOTS)]
    queued: Annotated[tuple[Tag, ...], Meta(max_length=MAX_LEASES)]
    running: Annotated[tuple[RunningJob, ...], Meta(max_length=MAX_LEASES)]
    unacked: Annotated[tuple[Tag, ...], Meta(max_length=MAX_LEASES)]  # oldest first
    load: Annotated[float, Meta(ge=0.0, le=1e6)]  # the host's load average over one minute
    steps_per_second: Annotated[float, Meta(ge=0.0, le=1e9)]
    drawn_by: Word  # renderer of the slots' pictures: native, gymnasium, or - if the task does not say
    host_class: HostClass = ""
    reason: Reason = ""  # the worker leaves, and this is its last heartbeat
    # Of `capacity`, what the worker's other runs use now: jobs given to it would wait.
    taken: Annotated[int, Meta(ge=0, le=MAX_LEASES)] = 0
    # Candidates' drives that a slot does side by side; `capacity` of a dream's run counts its dreams.
    side_by_side: Annotated[int, Meta(ge=1, le=MAX_SIDE_BY_SIDE)] = 1


class BundlePart(Message, frozen=True, kw_only=True):
    """Bytes from `offset` of a bundle of `total` bytes."""

    SCHEMA: ClassVar[str] = "bundle"

    sha256: Digest
    offset: Count
    total: Count
    data: Part


class UploadPart(Message, frozen=True, kw_only=True):
    """Bytes from `offset` of the output of the job `digest`; `sha256` is the hash of all `total` bytes."""

    SCHEMA: ClassVar[str] = "upload"

    digest: Digest
    sha256: Digest
    offset: Count
    total: Count
    data: Part


class ViewFrame(Message, frozen=True, kw_only=True):
    """A slot's current observation: a `height x width x 3` picture of 8-bit values, row by row; empty without one.

    `latent`, `state` and `parameters` are float32, little-endian; with the run's world model a viewer can decode them
    and continue the dream. They are empty if absent or too long.
    """

    SCHEMA: ClassVar[str] = "view"

    slot: Count
    tag: Tag  # of the job
    step: Count  # finished steps of the episode
    reward: Finite  # their total reward
    height: Annotated[int, Meta(ge=1, le=MAX_PICTURE_SIDE)]
    width: Annotated[int, Meta(ge=1, le=MAX_PICTURE_SIDE)]
    picture: Part
    packed: bool = False  # the picture is deflated
    kind: Kind = "score"  # of the job
    generation: Count = 0
    candidate: Count = 0
    seed: Count = 0
    action: Annotated[tuple[Finite, ...], Meta(max_length=64)] = ()  # the next one
    latent: Part = b""
    state: Part = b""  # the world model's recurrent state before the action
    parameters: Part = b""  # of the controller


@dataclass(frozen=True)
class HelloRequest:
    """A worker asks to join (JSON). Frozen: later versions may only ignore or add optional fields."""

    SCHEMA: ClassVar[str] = "hello-request"

    protocol_min: Count
    protocol_max: Count
    package: Word
    worker: Word
    tasks: Annotated[tuple[Word, ...], Meta(max_length=256)]
    fingerprint: Text
    slots: Count
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # whose versions the fingerprint names
    host_class: HostClass = field(default="", metadata=OPTIONAL)
    # Shows that it runs on the coordinator's own host, as its user (`common/security/host_key.py`); empty if not.
    host_token: Annotated[str, Meta(max_length=64)] = field(default="", metadata=OPTIONAL)


@dataclass(frozen=True)
class HelloReply:
    """The coordinator's reply (JSON, frozen likewise): accepted, or refused with the reason and the remedy."""

    SCHEMA: ClassVar[str] = "hello-reply"

    accepted: bool
    protocol_min: Count
    protocol_max: Count
    package: Word
    run: Word
    run_uid: Word
    incarnation: Count
    nonce: Word
    why: Text
    remedy: Text
    spec: dict[str, Any]
    intervals: dict[str, Any]
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # whose versions the fingerprint names
    numbering: Count = field(default=0, metadata=OPTIONAL)  # of the following batches; it increases
    share: FleetShare = field(default=1.0, metadata=OPTIONAL)  # of a worker's slots, relative to its other runs
    # Refused, as the worker did not announce this task of no package: its user may start it with that.
    unannounced_task: Annotated[str, Meta(max_length=128)] = field(default="", metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class ClaimNote:
    """A coordinator's identity, sent to another coordinator of the same run, as query and as reply (JSON)."""

    SCHEMA: ClassVar[str] = "claim"

    run_uid: Word
    incarnation: Count
    nonce: Word
    began: Annotated[float, Meta(ge=0.0, le=1e12)]  # seconds since 1970, by its own clock


@dataclass(frozen=True)
class Intervals:
    """Intervals of a worker's heartbeats and repetitions, in seconds; part of `HelloReply`."""

    beat: Annotated[float, Meta(ge=0.05, le=60.0)] = 1.0
    repeat: Annotated[float, Meta(ge=0.05, le=60.0)] = 1.0


@dataclass(frozen=True, kw_only=True)
class GenerationEvent:
    """Coordinator to everyone (JSON), as a generation closes; fitness statistics are over its candidates."""

    SCHEMA: ClassVar[str] = "generation-event"

    v: Count
    run: Word
    run_uid: Word
    incarnation: Count
    generation: Count
    mean: float
    std: float
    best: float
    worst: float
    sigma: float
    seconds: Seconds
    environment_steps: Count


@dataclass(frozen=True, kw_only=True)
class ControlReply:
    """Reply to a control request (JSON)."""

    SCHEMA: ClassVar[str] = "control-reply"

    v: Count
    run: Word
    accepted: bool
    why: Text
    again: Text = field(default="", metadata=OPTIONAL)  # the command that resumes the run, if the coordinator leaves
