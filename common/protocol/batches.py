"""Batches of parameter vectors that somebody else's search submits to a run: the query's header, its body, the replies.

They serve rules R29 to R31; `coordinator/addons/bridge/openapi.py` describes the same states and bounds for HTTP.
A body is the seeds as 64-bit integers, then the vectors as 32-bit floats, row by row, all little-endian.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.validation import OPTIONAL, Count, Text

MAX_LISTED = 512  # batches in one reply
MAX_BATCH = 32 << 20  # bytes of a body: 8 million numbers; docs/how-to/ask-tell.md has these bounds
MAX_CANDIDATES = 100_000  # of a batch
MAX_SEEDS = 10_000  # episodes of a candidate
MAX_EPISODES = 100_000  # of a batch: each is a job
LAST_SEED = 2**53 - 1  # the largest integer that every JSON parser reads exactly
PAGE_CANDIDATES = 1000  # of a reply
ID_RULE = "1 to 63 of A-Z, a-z, 0-9, '.', '_' and '-', and a letter or a digit first"
ID_PATTERN = "[A-Za-z0-9][A-Za-z0-9._-]{0,62}"
_ID = re.compile(ID_PATTERN)
_SHA256 = re.compile(r"[0-9a-f]{64}")

BatchState = Literal["", "uploading", "waiting", "running", "complete", "cancelled"]
FINAL = ("complete", "cancelled")
Refusal = Literal["", "malformed", "too large", "conflict", "unknown", "busy", "not external"]


class BatchError(DreamfleetError):
    """A batch is malformed, too large, unknown, in conflict with another one, or not taken now.

    `refusal` says which in a word.
    """

    def __init__(self, refusal: Refusal, text: str) -> None:
        super().__init__(text)
        self.refusal = refusal


@dataclass(frozen=True)
class BatchHeader:
    """What a batch is: its id, and the form and the SHA-256 (hexadecimal) of its body.

    `seeds` counts the seeds in the body. If it is 0, the run draws `episodes` seeds; if both are 0, as many as its
    `--episodes` says.
    """

    id: str
    population: int
    size: int  # parameters of a vector
    seeds: int
    episodes: int
    sha256: str

    def __post_init__(self) -> None:
        check_batch_id(self.id)
        if not 1 <= self.population <= MAX_CANDIDATES:
            kind: Refusal = "malformed" if self.population < 1 else "too large"
            raise BatchError(kind, f"a batch has 1 to {MAX_CANDIDATES:,} vectors, not {self.population:,}: split it")
        if self.size < 1:
            raise BatchError("malformed", "a vector has at least one number")
        if not (0 <= self.seeds <= MAX_SEEDS and 0 <= self.episodes <= MAX_SEEDS):
            raise BatchError("malformed", f"a candidate has 1 to {MAX_SEEDS:,} episodes")
        if self.seeds and self.episodes:
            raise BatchError("malformed", "give seeds, or a number of episodes, not both")
        if self.total > MAX_BATCH:
            form = f"{plural(self.population, 'vector')} of {plural(self.size, 'number')}"
            most = f"{MAX_BATCH:,} are allowed: split it into smaller batches"
            raise BatchError("too large", f"a batch of {form} has {self.total:,} bytes, {most}")
        if not _SHA256.fullmatch(self.sha256):
            raise BatchError("malformed", "sha256 must have 64 hexadecimal digits")
        self.check_episodes(self.seeds or self.episodes)

    def check_episodes(self, episodes: int) -> None:
        """`BatchError` if so many episodes a candidate are too many jobs."""
        if (jobs := self.population * episodes) > MAX_EPISODES:
            form = f"{plural(self.population, 'vector')} of {plural(episodes, 'episode')}"
            most = f"{MAX_EPISODES:,} are allowed: split it into smaller batches"
            raise BatchError("too large", f"{form} each are {jobs:,} episodes, {most}")

    @property
    def total(self) -> int:
        """Bytes of the body."""
        return 8 * self.seeds + 4 * self.population * self.size

    @property
    def content(self) -> bytes:
        """The identity of what is to be scored, whatever the id: a SHA-256."""
        form = f"{self.population} {self.size} {self.seeds} {self.episodes} {self.sha256}"
        return hashlib.sha256(form.encode()).digest()

    @property
    def parameters(self) -> str:
        """The header as a Zenoh query's parameters."""
        return ";".join(f"{name}={value}" for name, value in vars(self).items())

    @classmethod
    def from_parameters(cls, get: Callable[[str], str | None]) -> BatchHeader:
        """Read the parameters of a query; `BatchError` if one is missing or wrong."""
        counts = {name: read_count(get, name) for name in ("population", "size", "seeds", "episodes")}
        return cls(id=get("id") or "", sha256=get("sha256") or "", **counts)


def check_batch_id(text: str) -> str:
    """Return `text` if it may name a batch; `BatchError` otherwise."""
    if not _ID.fullmatch(text):
        raise BatchError("malformed", f"{text[:70]!r} cannot name a batch: use {ID_RULE}")
    return text


def read_count(get: Callable[[str], str | None], name: str) -> int:
    """A whole number of a query's parameters, 0 if it is not given; `BatchError` for anything else."""
    text = get(name) or "0"
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise BatchError("malformed", f"{name} must be a whole number, not {text[:20]!r}")
    return int(text)


def pack_batch(
    batch_id: str, vectors: object, seeds: Sequence[int] | None = None, episodes: int = 0
) -> tuple[BatchHeader, bytes]:
    """The header and the body of a batch; `BatchError` if `vectors` `(n, size)` or the seeds are not what they must be.

    Numbers are rounded to float32, as candidates are.
    """
    plain = [] if seeds is None else list(seeds)
    if seeds is not None and not plain:
        raise BatchError("malformed", "the list of seeds is empty: leave it out, or name at least one seed")
    whole = all(isinstance(each, (int, np.integer)) and not isinstance(each, bool) for each in plain)
    if not whole or not all(0 <= each <= LAST_SEED for each in plain):
        raise BatchError("malformed", f"seeds are whole numbers from 0 to {LAST_SEED}")
    rows = _as_float32(vectors)
    form = {"population": rows.shape[0], "size": rows.shape[1], "seeds": len(plain), "episodes": episodes}
    BatchHeader(batch_id, **form, sha256=64 * "0")  # before so many bytes are copied and hashed
    body = np.array(plain, dtype="<i8").tobytes() + rows.tobytes()
    check_vectors(body[8 * len(plain) :], rows.shape[1])
    return BatchHeader(batch_id, **form, sha256=hashlib.sha256(body).hexdigest()), body


def _as_float32(vectors: object) -> NDArray[np.float32]:
    try:
        with np.errstate(over="ignore"):
            given = np.asarray(vectors)
            if given.dtype.kind not in "iufO":  # numpy would read texts and truth values as numbers
                raise TypeError(f"{given.dtype} is no type of numbers")
            rows = np.ascontiguousarray(given, dtype="<f4")
    except (ValueError, TypeError, OverflowError) as error:
        raise BatchError("malformed", "vectors must be rows of numbers, all of one length") from error
    if rows.ndim != 2 or not len(rows):
        raise BatchError("malformed", f"vectors must have the shape (n, size) with n at least 1, not {rows.shape}")
    return rows


def unpack_seeds(header: BatchHeader, body: bytes) -> tuple[int, ...]:
    """The seeds in a body; `BatchError` if one is out of bounds."""
    seeds = np.frombuffer(body[: 8 * header.seeds], dtype="<i8")
    if ((seeds < 0) | (seeds > LAST_SEED)).any():
        raise BatchError("malformed", f"seeds are whole numbers from 0 to {LAST_SEED}")
    return tuple(seeds.tolist())


def check_vectors(data: bytes, size: int) -> None:
    """`BatchError` if a number of these vectors is NaN or infinite in single precision."""
    wrong = np.argwhere(~np.isfinite(np.frombuffer(data, dtype="<f4").reshape(-1, size)))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise BatchError("malformed", f"number {column} of vector {row} is not finite in single precision")


@dataclass(frozen=True)
class CandidateError:
    """Why a candidate of a batch has no fitness."""

    candidate: Count
    error: Text


@dataclass(frozen=True)
class BatchLine:
    """A batch in a list: its id, its state, and its candidates."""

    id: Annotated[str, Meta(max_length=128)]
    state: BatchState
    population: Count
    generation: Count | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class BatchReply:
    """The reply to every query about a batch (JSON): refused with a reason, or the batch's state and a page of scores.

    The page begins with candidate `offset`. A candidate without a fitness is not scored yet, unless `errors` names it.
    """

    SCHEMA = "batch-reply"

    v: Count
    run: Annotated[str, Meta(max_length=128)]
    refused: Refusal = ""
    why: Text = ""
    id: Annotated[str, Meta(max_length=128)] = ""
    state: BatchState = ""
    population: Count = 0
    size: Count = 0
    episodes: Count = 0  # of each candidate
    done: Count = 0  # candidates that have a fitness or an error
    generation: Count | None = None  # of the run in which it is scored; `None` while it waits
    run_state: Annotated[str, Meta(max_length=64)] = ""
    run_why: Text = ""  # why the run is paused
    offset: Count = 0
    fitness: Annotated[tuple[float | None, ...], Meta(max_length=PAGE_CANDIDATES)] = ()
    errors: Annotated[tuple[CandidateError, ...], Meta(max_length=PAGE_CANDIDATES)] = ()
    is_new: bool = field(default=False, metadata=OPTIONAL)  # this query completed it
    # Of the query `list`: open batches in their order, then finished ones, the last first.
    batches: Annotated[tuple[BatchLine, ...], Meta(max_length=MAX_LISTED)] = field(default=(), metadata=OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class BatchEvent:
    """Coordinator to everyone (JSON): a batch changed its state, or has further scores."""

    SCHEMA = "batch-event"

    v: Count
    run: Annotated[str, Meta(max_length=128)]
    incarnation: Count
    id: Annotated[str, Meta(max_length=128)]
    state: BatchState
    done: Count
    population: Count
