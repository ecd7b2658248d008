"""All messages of protocol version 2, as frozen dataclasses.

The annotations are the schema: `dreamfleet.common.protocol.codec` derives its checks from them. A message has at most
`MAX_MESSAGE` bytes; larger batches are split, and long vectors and files are sent in parts.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.measures import MeasureNames, Measures
from dreamfleet.common.serialization.display import DisplayedFields
from dreamfleet.common.serialization.optional_fields import OPTIONAL, to_dict
from dreamfleet.common.serialization.validation import Between, Count, Digest, Length, Seconds, Text, Word

MAX_MESSAGE = 48 * 1024
MAX_PART = 40 * 1024  # leaves room for the rest of the message
MAX_PICTURE_SIDE = 256  # pixels of a live frame's picture
MAX_UPLOAD = 32 << 20  # a rollout of 1000 steps has 12 MB (64x64) or 28 MB (96x96) uncompressed
MAX_OPTIONS = 8_000  # characters; statuses and controllers contain them too
MAX_END = 32  # characters of an end rule
MAX_REASON = 400  # characters of why a worker leaves, or a run has ended
MAX_LEASES = 1024  # of one worker; a heartbeat lists them all and must stay under MAX_MESSAGE
MOST_TOGETHER = 8  # candidates' drives that a slot does side by side
MAX_BATCHES = 2**53  # never reached
MAX_SLOTS = 4096  # of one worker
TAG_BYTES = 8
MIN_TEMPERATURE, MAX_TEMPERATURE = 1e-3, 1e3  # of a dream
OWN_END_VERSION = 10  # added to the world's version by runs with an end rule of their own


Tag = Annotated[bytes, Length(TAG_BYTES, TAG_BYTES)]  # the first bytes of a digest, unique among one worker's jobs
Part = Annotated[bytes, Length(0, MAX_PART)]
Temperature = Annotated[float, Between(MIN_TEMPERATURE, MAX_TEMPERATURE)]
Horizon = Annotated[int, Between(1, 10**6)]  # maximum steps of an episode that is scored for the optimiser
Share = Annotated[float, Between(0.0, 1.0)]
MIN_SHARE, MAX_SHARE = 0.01, 100.0
FleetShare = Annotated[float, Between(MIN_SHARE, MAX_SHARE)]  # of a fleet's slots, relative to the other runs' shares
Patience = Annotated[int, Between(0, 10**6)]  # steps without reward after which a scored episode ends; 0: never
Packages = Annotated[tuple[Word, ...], Length(0, 64)]
Reason = Annotated[str, Length(0, MAX_REASON)]  # why a worker leaves, or why a run has ended; empty: nothing is said
HostClass = Annotated[str, Length(0, 32)]  # see `host_classes`; empty: not known yet
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
    bundle: Annotated[str, Length(0, 64)]  # SHA-256 of the bundle's file, hexadecimal; empty without one
    horizon: Horizon
    patience: Patience
    controller: ControllerShape | None = field(default=None, metadata=OPTIONAL)  # `None`: linear on z and h
    temperature: Temperature | None = field(default=None, metadata=OPTIONAL)  # of a dream
    # The task's options, as canonical JSON, such as arguments of its environment.
    options: Annotated[str, Length(0, MAX_OPTIONS)] = field(default="", metadata=OPTIONAL)
    # Version of the task: another one computes another fitness.
    version: Annotated[int, Between(1, 10**6)] = field(default=1, metadata=OPTIONAL)
    recorded: Share = field(default=0.0, metadata=OPTIONAL)  # share of dreams that begin at recorded states
    driven: bool = field(default=False, metadata=OPTIONAL)  # score a dream task in the real environment
    # When dreams end, in place of the bundle's own rule: a text that `EndRule.parse` reads. Empty: the bundle's own.
    end: Annotated[str, Length(0, MAX_END)] = field(default="", metadata=OPTIONAL)
    measures: MeasureNames = field(default=(), metadata=OPTIONAL)  # that each episode gives beside its fitness

    @property
    def world_version(self) -> int:
        """Version of the world that is scored in, which controllers keep: `version` without `OWN_END_VERSION`."""
        return self.version - OWN_END_VERSION if self.end else self.version

    def option(self, name: str, default: Any = None) -> Any:
        """The value of one of the task's options."""
        return json.loads(self.options or "{}").get(name, default)

    def with_overrides(
        self, temperature: float | None = None, horizon: int | None = None, patience: int | None = None,
        driven: bool | None = None,
    ) -> TaskSpec:  # fmt: skip
        """This specification with other values; `None` leaves a value as it is."""
        named = {"temperature": temperature, "horizon": horizon, "patience": patience, "driven": driven}
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
        return json.dumps(to_dict(self), sort_keys=True)


@dataclass(frozen=True, kw_only=True)
class Message:
    """Fields of every message; the codec adds the protocol version."""

    SCHEMA: ClassVar[str]

    run_uid: Annotated[str, Length(32, 32)]
    incarnation: Count


@dataclass(frozen=True)
class VectorPart:
    """Bytes from `offset` of an array of little-endian `dtype` and `shape` whose SHA-256 is `id`."""

    id: Digest
    dtype: Literal["<f4", "<f8"]
    shape: Annotated[tuple[Count, ...], Length(1, 4)]
    offset: Count
    data: Part


@dataclass(frozen=True)
class Job:
    """One episode of a candidate, or of the mean (`evaluate`, `collect`): the unit of dispatch."""

    kind: Kind
    task: Word
    generation: Count
    candidate: Count
    episode: Count
    seeds: Annotated[tuple[Count, ...], Length(1, 64)]
    vector: Digest
    digest: Digest
    stall: Seconds  # a slot without a step for so long is hung
    # Overrides of the specification; `None`: none.
    temperature: Temperature | None = field(default=None, metadata=OPTIONAL)
    horizon: Horizon | None = field(default=None, metadata=OPTIONAL)
    patience: Patience | None = field(default=None, metadata=OPTIONAL)
    driven: bool | None = field(default=None, metadata=OPTIONAL)

    @property
    def overrides(self) -> tuple[float | None, int | None, int | None, bool | None]:
        """The overrides, in the order of `TaskSpec.with_overrides`."""
        return self.temperature, self.horizon, self.patience, self.driven

    @property
    def runs_alone(self) -> bool:
        """Whether a slot runs this job alone; candidates' jobs may share one."""
        return self.kind != "score"

    def spec(self, run_spec: TaskSpec) -> TaskSpec:
        """The run's specification with this job's overrides."""
        return run_spec.with_overrides(*self.overrides)


@dataclass(frozen=True)
class Verdict:
    """The coordinator's decision on a result; the worker stops repeating that result."""

    digest: Digest
    verdict: VerdictWord


@dataclass(frozen=True, kw_only=True)
class JobBatch(Message):
    """Coordinator to one worker; `number` counts from 1 without gaps in each `numbering`."""

    SCHEMA: ClassVar[str] = "job"

    nonce: Word
    numbering: Count
    number: Count
    vectors: tuple[VectorPart, ...]
    jobs: tuple[Job, ...]
    cancels: tuple[Digest, ...]
    verdicts: tuple[Verdict, ...]
    leave: bool = field(default=False, metadata=OPTIONAL)  # the run is over: the worker exits
    ended: bool = field(default=False, metadata=OPTIONAL)  # the run has ended: the worker leaves it
    why: Reason = field(default="", metadata=OPTIONAL)  # it ended


@dataclass(frozen=True)
class Result:
    """A finished job: a fitness or an error; a collected rollout also has the hash of its upload."""

    digest: Digest
    fitness: float | None
    steps: Count
    seconds: Seconds
    error: Failure | None
    upload: Digest | None
    measures: Measures = field(default=(), metadata=OPTIONAL)  # those that the specification names, in its order


@dataclass(frozen=True, kw_only=True)
class ResultBatch(Message):
    """One worker to the coordinator; each result is repeated until its verdict arrives."""

    SCHEMA: ClassVar[str] = "result"

    fingerprint: Text
    results: tuple[Result, ...]
    host_class: HostClass = field(default="", metadata=OPTIONAL)  # of the worker's host


@dataclass(frozen=True)
class RunningJob:
    """A job in a slot, and its environment steps so far."""

    tag: Tag
    steps: Count


@dataclass(frozen=True, kw_only=True)
class Heartbeat(Message):
    """One worker to the coordinator, periodically: its jobs and load."""

    SCHEMA: ClassVar[str] = "beat"

    nonce: Word
    numbering: Count
    seen: Annotated[int, Between(0, MAX_BATCHES)]  # all batches of this numbering up to this number have arrived
    capacity: Annotated[int, Between(0, MAX_LEASES)]  # slots times the jobs that the task batches in one
    slots: Annotated[int, Between(0, MAX_SLOTS)]
    queued: Annotated[tuple[Tag, ...], Length(0, MAX_LEASES)]
    running: Annotated[tuple[RunningJob, ...], Length(0, MAX_LEASES)]
    unacked: Annotated[tuple[Tag, ...], Length(0, MAX_LEASES)]  # oldest first
    load: Annotated[float, Between(0.0, 1e6)]  # the host's load average over one minute
    steps_per_second: Annotated[float, Between(0.0, 1e9)]
    drawn_by: Word  # renderer of the slots' pictures: native, gymnasium, or - if the task does not say
    host_class: HostClass = field(default="", metadata=OPTIONAL)
    reason: Reason = field(default="", metadata=OPTIONAL)  # the worker leaves, and this is its last heartbeat
    # Of `capacity`, what the worker's other runs use now: jobs given to it would wait.
    taken: Annotated[int, Between(0, MAX_LEASES)] = field(default=0, metadata=OPTIONAL)
    # Candidates' drives that a slot does side by side; `capacity` of a dream's run counts its dreams.
    together: Annotated[int, Between(1, MOST_TOGETHER)] = field(default=1, metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class BundlePart(Message):
    """Bytes from `offset` of a bundle of `total` bytes."""

    SCHEMA: ClassVar[str] = "bundle"

    sha256: Digest
    offset: Count
    total: Count
    data: Part


@dataclass(frozen=True, kw_only=True)
class UploadPart(Message):
    """Bytes from `offset` of the output of the job `digest`; `sha256` is the hash of all `total` bytes."""

    SCHEMA: ClassVar[str] = "upload"

    digest: Digest
    sha256: Digest
    offset: Count
    total: Count
    data: Part


@dataclass(frozen=True, kw_only=True)
class ViewFrame(Message):
    """A slot's current observation: a `height x width x 3` picture of 8-bit values, row by row; empty without one.

    `latent`, `state` and `parameters` are float32, little-endian; with the run's world model a viewer can decode them
    and continue the dream. They are empty if absent or too long.
    """

    SCHEMA: ClassVar[str] = "view"

    slot: Count
    tag: Tag  # of the job
    step: Count  # finished steps of the episode
    reward: float  # their total reward
    height: Annotated[int, Between(1, MAX_PICTURE_SIDE)]
    width: Annotated[int, Between(1, MAX_PICTURE_SIDE)]
    picture: Part
    packed: bool = field(default=False, metadata=OPTIONAL)  # the picture is deflated
    kind: Kind = field(default="score", metadata=OPTIONAL)  # of the job
    generation: Count = field(default=0, metadata=OPTIONAL)
    candidate: Count = field(default=0, metadata=OPTIONAL)
    seed: Count = field(default=0, metadata=OPTIONAL)
    action: Annotated[tuple[float, ...], Length(0, 64)] = field(default=(), metadata=OPTIONAL)  # the next one
    latent: Part = field(default=b"", metadata=OPTIONAL)
    state: Part = field(default=b"", metadata=OPTIONAL)  # the world model's recurrent state before the action
    parameters: Part = field(default=b"", metadata=OPTIONAL)  # of the controller


@dataclass(frozen=True)
class HelloRequest:
    """A worker asks to join (JSON). Frozen: later versions may only ignore or add optional fields."""

    SCHEMA: ClassVar[str] = "hello-request"

    protocol_min: Count
    protocol_max: Count
    package: Word
    worker: Word
    tasks: Annotated[tuple[Word, ...], Length(0, 256)]
    fingerprint: Text
    slots: Count
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # whose versions the fingerprint names
    host_class: HostClass = field(default="", metadata=OPTIONAL)
    # Shows that it runs on the coordinator's own host, as its user (`common/security/anchor_key.py`); empty if not.
    anchor: Annotated[str, Length(0, 64)] = field(default="", metadata=OPTIONAL)


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
    unannounced_task: Annotated[str, Length(0, 128)] = field(default="", metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class ClaimNote:
    """A coordinator's identity, sent to another coordinator of the same run, as query and as reply (JSON)."""

    SCHEMA: ClassVar[str] = "claim"

    run_uid: Word
    incarnation: Count
    nonce: Word
    began: Annotated[float, Between(0.0, 1e12)]  # seconds since 1970, by its own clock


@dataclass(frozen=True)
class Intervals:
    """Intervals of a worker's heartbeats and repetitions, in seconds; part of `HelloReply`."""

    beat: Annotated[float, Between(0.05, 60.0)] = 1.0
    repeat: Annotated[float, Between(0.05, 60.0)] = 1.0


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


MSGPACK_MESSAGES: tuple[type[Message], ...] = (JobBatch, ResultBatch, Heartbeat, BundlePart, UploadPart, ViewFrame)
"""The messages in msgpack; the others are JSON."""
