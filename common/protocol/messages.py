"""Every message of protocol version 2, as frozen dataclasses.

The annotations are the schema: `dreamfleet.common.protocol.codec` derives its checks from them. A message is at
most `MAX_MESSAGE` bytes; batches split, long vectors and files travel in parts.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.serialization.constraints import Between, Count, Digest, Length, Seconds, Text, Word
from dreamfleet.common.serialization.optional_fields import OPTIONAL, to_dict

MAX_MESSAGE = 48 * 1024
MAX_PART = 40 * 1024  # room for the envelope around a part's bytes
MAX_PICTURE_SIDE = 256  # pixels of a live frame's picture
MAX_UPLOAD = 32 << 20  # a rollout of 1000 steps is 12 MB (64x64) or 28 MB (96x96) before it is compressed
MAX_OPTIONS = 8_000  # characters: a status and a controller carry them too
MAX_LEASES = 1024  # of one worker: so that a beat, which names them all, stays under MAX_MESSAGE
MAX_BATCHES = 2**53  # of one life of a coordinator: no worker comes near it
MAX_SLOTS = 4096  # of one worker
TAG_BYTES = 8
MIN_TEMPERATURE, MAX_TEMPERATURE = 1e-3, 1e3  # of a dream


Tag = Annotated[
    bytes, Length(TAG_BYTES, TAG_BYTES)
]  # a digest's first bytes, where only a worker's own jobs are told apart
Part = Annotated[bytes, Length(0, MAX_PART)]
Temperature = Annotated[float, Between(MIN_TEMPERATURE, MAX_TEMPERATURE)]
Horizon = Annotated[int, Between(1, 10**6)]  # an episode's steps at most, when scored for the strategy
Share = Annotated[float, Between(0.0, 1.0)]
Patience = Annotated[int, Between(0, 10**6)]  # steps without reward before a scored episode is cut; 0: never
Packages = Annotated[tuple[Word, ...], Length(0, 64)]
HostClass = Annotated[str, Length(0, 32)]  # hosts of one compute the same bits; empty: not known yet
Kind = Literal["score", "evaluate", "collect"]
VerdictWord = Literal["accepted", "duplicate", "obsolete", "refused"]


@dataclass(frozen=True)
class TaskSpec:
    """What is scored in, frozen with a run: a fitness is a function of this, the parameters and the seeds alone.

    >>> from dreamfleet import TaskSpec, find_bundle
    >>> spec = TaskSpec("car-racing", find_bundle("tiny").sha256, horizon=1000, patience=100)
    >>> spec.with_overrides(horizon=200).horizon
    200
    """

    task: Word
    bundle: Annotated[str, Length(0, 64)]  # SHA-256 of the bundle's file, hexadecimal; empty where there is none
    horizon: Horizon
    patience: Patience
    controller: ControllerShape | None = field(default=None, metadata=OPTIONAL)  # `None`: linear on z and h
    temperature: Temperature | None = field(default=None, metadata=OPTIONAL)  # of a dream
    # The task's own, as canonical JSON: what its environment is made with, how it normalises what it observes.
    options: Annotated[str, Length(0, MAX_OPTIONS)] = field(default="", metadata=OPTIONAL)
    # The task's own version: another one gives other fitnesses.
    version: Annotated[int, Between(1, 10**6)] = field(default=1, metadata=OPTIONAL)
    recorded: Share = field(default=0.0, metadata=OPTIONAL)  # of the dreams: begins where recorded drives were
    driven: bool = field(default=False, metadata=OPTIONAL)  # of a dream: in the world that it dreams of, after all

    def option(self, name: str, default: Any = None) -> Any:
        """One of the task's own options."""
        return json.loads(self.options or "{}").get(name, default)

    def with_overrides(
        self, temperature: float | None = None, horizon: int | None = None, patience: int | None = None,
        driven: bool | None = None,
    ) -> TaskSpec:  # fmt: skip
        """The same at another temperature, horizon or patience, or driven instead of dreamt; `None`: at its own."""
        named = {"temperature": temperature, "horizon": horizon, "patience": patience, "driven": driven}
        others: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
        return replace(self, **others) if others else self

    def digest(self, kind: Kind, vector: bytes, seeds: tuple[int, ...]) -> bytes:
        """A job's identity: SHA-256 over its kind, this specification, the parameters' hash and the seeds."""
        text = f'{{"kind": "{kind}", "seeds": {list(seeds)}, "spec": {_spec_json(self)}}}'
        return hashlib.sha256(vector + text.encode()).digest()


@lru_cache  # bounded: a run's temperature may rise again and again
def _spec_json(spec: TaskSpec) -> str:
    return json.dumps(to_dict(spec), sort_keys=True)


@dataclass(frozen=True, kw_only=True)
class Message:
    """What every message carries beside the protocol version, which the codec adds."""

    SCHEMA: ClassVar[str]

    run_uid: Annotated[str, Length(32, 32)]
    incarnation: Count


@dataclass(frozen=True)
class VectorPart:
    """Part of a vector: little-endian bytes from `offset` of the array of `dtype` and `shape` whose hash is `id`."""

    id: Digest
    dtype: Literal["<f4", "<f8"]
    shape: Annotated[tuple[Count, ...], Length(1, 4)]
    offset: Count
    data: Part


@dataclass(frozen=True)
class Job:
    """Candidate x episode, the unit of dispatch."""

    kind: Kind
    task: Word
    generation: Count
    candidate: Count
    episode: Count
    seeds: Annotated[tuple[Count, ...], Length(1, 64)]
    vector: Digest
    digest: Digest
    stall: Seconds  # no step for so long: hung
    # Under which it is scored where that is not the specification's own; `None`: it is.
    temperature: Temperature | None = field(default=None, metadata=OPTIONAL)
    horizon: Horizon | None = field(default=None, metadata=OPTIONAL)
    patience: Patience | None = field(default=None, metadata=OPTIONAL)
    driven: bool | None = field(default=None, metadata=OPTIONAL)

    @property
    def overrides(self) -> tuple[float | None, int | None, int | None, bool | None]:
        """What it names of its specification."""
        return self.temperature, self.horizon, self.patience, self.driven

    @property
    def runs_alone(self) -> bool:
        """Whether a slot does it by itself, however many dreams it would dream at once."""
        return self.kind != "score" or bool(self.driven)

    def spec(self, own: TaskSpec) -> TaskSpec:
        """What it is scored in; `own` is the run's specification."""
        return own.with_overrides(*self.overrides)


@dataclass(frozen=True)
class Verdict:
    """What became of a result; any verdict ends its repetition."""

    digest: Digest
    verdict: VerdictWord


@dataclass(frozen=True, kw_only=True)
class JobBatch(Message):
    """Coordinator to one worker; each `numbering` counts from 1 without a gap."""

    SCHEMA: ClassVar[str] = "job"

    nonce: Word
    numbering: Count
    number: Count
    vectors: tuple[VectorPart, ...]
    jobs: tuple[Job, ...]
    cancels: tuple[Digest, ...]
    verdicts: tuple[Verdict, ...]
    leave: bool = field(default=False, metadata=OPTIONAL)  # the run ends with its workers


@dataclass(frozen=True)
class Result:
    """A finished job: a fitness, or the error that kept it from one; a collected rollout names its upload."""

    digest: Digest
    fitness: float | None
    steps: Count
    seconds: Seconds
    error: Text | None
    upload: Digest | None


@dataclass(frozen=True, kw_only=True)
class ResultBatch(Message):
    """One worker to the coordinator; repeated until each result has its verdict."""

    SCHEMA: ClassVar[str] = "result"

    fingerprint: Text
    results: tuple[Result, ...]
    # Of the host that scored; `None` from workers of before there were classes, here and in the messages below.
    host_class: HostClass | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class RunningJob:
    """A job in a slot's hands, and how many environment steps it has made."""

    tag: Tag
    steps: Count


@dataclass(frozen=True, kw_only=True)
class Heartbeat(Message):
    """One worker to the coordinator, at its interval: what it holds."""

    SCHEMA: ClassVar[str] = "beat"

    nonce: Word
    numbering: Count
    seen: Annotated[int, Between(0, MAX_BATCHES)]  # every batch of this numbering up to this number has arrived
    capacity: Annotated[int, Between(0, MAX_LEASES)]  # slots x the task's batch size
    slots: Annotated[int, Between(0, MAX_SLOTS)]
    queued: Annotated[tuple[Tag, ...], Length(0, MAX_LEASES)]
    running: Annotated[tuple[RunningJob, ...], Length(0, MAX_LEASES)]
    unacked: Annotated[tuple[Tag, ...], Length(0, MAX_LEASES)]  # oldest first
    load: Annotated[float, Between(0.0, 1e6)]  # the host's, over one minute
    steps_per_second: Annotated[float, Between(0.0, 1e9)]
    drawn_by: Word  # whose picture the slots see: native, gymnasium, or - where a task does not say
    host_class: HostClass | None = field(default=None, metadata=OPTIONAL)


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
    """Bytes from `offset` of what the job `digest` made; `sha256` is of all `total` bytes."""

    SCHEMA: ClassVar[str] = "upload"

    digest: Digest
    sha256: Digest
    offset: Count
    total: Count
    data: Part


@dataclass(frozen=True, kw_only=True)
class ViewFrame(Message):
    """What a slot sees: a `height x width x 3` picture of 8-bit values, row by row; empty where it sees none.

    `latent`, `state` and `parameters` are float32, little-endian: by them and the run's world model a viewer decodes
    and dreams on for itself. They are empty where there are none, and where they are too long.
    """

    SCHEMA: ClassVar[str] = "view"

    slot: Count
    tag: Tag  # of the job
    step: Count  # of the episode: those that were made before this moment
    reward: float  # the sum of what they brought
    height: Annotated[int, Between(1, MAX_PICTURE_SIDE)]
    width: Annotated[int, Between(1, MAX_PICTURE_SIDE)]
    picture: Part
    packed: bool = field(default=False, metadata=OPTIONAL)  # the picture is deflated
    kind: Kind = field(default="score", metadata=OPTIONAL)  # of job; an evaluation is of its generation's mean
    generation: Count = field(default=0, metadata=OPTIONAL)
    candidate: Count = field(default=0, metadata=OPTIONAL)
    seed: Count = field(default=0, metadata=OPTIONAL)
    action: Annotated[tuple[float, ...], Length(0, 64)] = field(default=(), metadata=OPTIONAL)  # that follows
    latent: Part = field(default=b"", metadata=OPTIONAL)
    state: Part = field(default=b"", metadata=OPTIONAL)  # what the world model remembers before the action
    parameters: Part = field(default=b"", metadata=OPTIONAL)  # of the controller


@dataclass(frozen=True)
class HelloRequest:
    """A worker asks to join (JSON, frozen for ever: later versions may only ignore or add optional fields)."""

    SCHEMA: ClassVar[str] = "hello-request"

    protocol_min: Count
    protocol_max: Count
    package: Word
    worker: Word
    tasks: Annotated[tuple[Word, ...], Length(0, 256)]
    fingerprint: Text
    slots: Count
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # whose versions the fingerprint names
    host_class: HostClass | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class HelloReply:
    """The coordinator's answer (JSON, frozen for ever): accepted, or refused with the reason and the remedy."""

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
    packages: Packages = field(
        default=NUMERIC_PACKAGES, metadata=OPTIONAL
    )  # whose versions the run's fingerprint names
    numbering: Count = field(default=0, metadata=OPTIONAL)  # of the batches that follow; it rises
    classes: bool = field(default=False, metadata=OPTIONAL)  # that a worker names; earlier ones drop it


@dataclass(frozen=True, kw_only=True)
class ClaimNote:
    """Who a coordinator is, to another one of its name (JSON): the question as well as the answer."""

    SCHEMA: ClassVar[str] = "claim"

    run_uid: Word
    incarnation: Count
    nonce: Word
    began: Annotated[float, Between(0.0, 1e12)]  # seconds since 1970, by its own clock


@dataclass(frozen=True)
class Intervals:
    """How often a worker beats and repeats, in seconds; part of the accepting answer."""

    beat: Annotated[float, Between(0.05, 60.0)] = 1.0
    repeat: Annotated[float, Between(0.05, 60.0)] = 1.0


@dataclass(frozen=True, kw_only=True)
class GenerationEvent:
    """Coordinator to anyone (JSON), as a generation ends; fitness statistics are over its candidates."""

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
    """Answer to a control verb (JSON)."""

    SCHEMA: ClassVar[str] = "control-reply"

    v: Count
    run: Word
    accepted: bool
    why: Text
    again: Text = field(default="", metadata=OPTIONAL)  # the command that continues a run which is left


MSGPACK_MESSAGES: tuple[type[Message], ...] = (JobBatch, ResultBatch, Heartbeat, BundlePart, UploadPart, ViewFrame)
"""The messages in msgpack; the others are JSON."""
