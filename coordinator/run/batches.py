"""The batches that others submit to a run: they arrive in parts, wait, are scored as generations, and are read by id.

No transport: the service hands over what a query says, and sends the reply once the journal has committed.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from dreamfleet.common.errors import NotWritableNowError
from dreamfleet.common.printable import plural, truncate
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.batches import (
    FINAL,
    MAX_BATCH,
    MAX_LISTED,
    PAGE_CANDIDATES,
    BatchError,
    BatchEvent,
    BatchHeader,
    BatchReply,
    CandidateError,
    check_batch_id,
    check_vectors,
    read_count,
    unpack_seeds,
)
from dreamfleet.common.protocol.messages import MAX_PART, UploadPart
from dreamfleet.common.runs.seeds import remark_on_seeds, training_seed
from dreamfleet.coordinator.dispatch.failures import LONGEST_ERROR
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.upload_assembler import TOO_MANY, UploadAssembler
from dreamfleet.coordinator.run.external_generations import CANCELLED, ExternalGenerations
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.shown_state import shown_state
from dreamfleet.coordinator.storage.batch_records import StoredBatch

MAX_WAITING = 256  # batches; docs/how-to/ask-tell.md
MAX_WAITING_SIZE = 8 * MAX_BATCH  # bytes of their vectors
PAGE_BYTES = 30_000  # of a reply's scores and errors
log = logging.getLogger(__name__)
Parameters = Callable[[str], str | None]


class Batches:
    """Takes, reads and cancels the batches of a `run` named `name`."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        self._journal = run.journal
        self._name = name
        self._uploads = UploadAssembler()
        self._remarked = False  # on test seeds: once in a coordinator's incarnation
        self._announced: tuple[str, int] | None = None  # the open batch's id and its candidates that were done
        self._durable: Generation | None = None  # the open generation as the journal has it

    def answer(self, verb: str, get: Parameters, payload: bytes, now: float) -> BatchReply:
        """The reply to a query `submit`, `read`, `cancel` or `list`, whose parameters `get` returns.

        R29: while the journal cannot be written, nothing is taken, and the reply says what is durable.
        """
        stalled = self.run.state.stalled
        verbs: dict[str, Callable[[], BatchReply]] = {
            "submit": lambda: self._submit(BatchHeader.from_parameters(get), read_count(get, "offset"), payload, now),
            "read": lambda: self._describe(self._find(get), read_count(get, "offset")),
            "cancel": lambda: self._cancel(self._find(get)),
            "list": lambda: replace(self._head(), batches=tuple(self._journal.batches.lines(MAX_LISTED))),
        }
        try:
            if not self.run.settings.is_external:
                raise BatchError(
                    "not external",
                    f"run {self._name} has a search of its own ({self.run.settings.optimiser}): submit to one that "
                    "was started with --optimiser external",
                )
            if verb not in verbs:
                raise BatchError("malformed", f"{truncate(verb, 60)!r} is no verb of batches: {', '.join(verbs)}")
            if stalled is not None and verb in ("submit", "cancel"):
                raise BatchError("busy", f"run {self._name} is paused: {stalled.why}. Then send the same again")
            with nullcontext() if stalled is None else self._journal.as_committed():
                return verbs[verb]()
        except BatchError as error:
            return replace(self._head(), refused=error.refusal, why=truncate(str(error), 1000))
        except NotWritableNowError as error:
            if stalled is not None:
                raise
            self.run.wait_until_writable(error)
            return self.answer(verb, get, payload, now)

    def tick(self, now: float) -> None:
        """Forget uploads without progress: their senders begin again."""
        self._uploads.tick(now)

    def take_events(self, closed: Iterable[int], *, progress: bool) -> list[BatchEvent]:
        """An event for each closed generation, and with `progress` one for the open batch if it has new scores."""
        if not self.run.settings.is_external:
            return []
        self._durable = None
        found = [batch for number in closed if (batch := self._journal.batches.of(number)) is not None]
        events = [self._event(batch, batch.population) for batch in found]
        generation = self.run.generation
        batch = self._journal.batches.of(generation.number) if progress and generation.population else None
        if batch is not None:
            *_, done = self._page(batch, 0)
            if (batch.id, done) != self._announced:
                self._announced = batch.id, done
                events.append(self._event(batch, done))
        return events

    def _event(self, batch: StoredBatch, done: int) -> BatchEvent:
        return BatchEvent(v=keys.PROTOCOL_VERSION, run=self._name, incarnation=self.run.incarnation, id=batch.id,
                          state=batch.state, done=done, population=batch.population)  # fmt: skip

    def _find(self, get: Parameters) -> StoredBatch:
        batch_id = check_batch_id(get("id") or "")
        batch = self._journal.batches.find(batch_id)
        if batch is None:
            raise BatchError("unknown", f"run {self._name} has no batch {batch_id}: submit it")
        return batch

    def _submit(self, header: BatchHeader, offset: int, data: bytes, now: float) -> BatchReply:
        """Take a part of a batch; the last missing one makes the batch wait to be scored.

        R30: an id names one content, so a repeated submission changes nothing.
        """
        stored = self._journal.batches.find(header.id)
        if stored is not None:
            if stored.content != header.content:
                raise BatchError(
                    "conflict",
                    f"batch {header.id} was submitted with other vectors or seeds: choose another id, such as a random "
                    "one",
                )
            return self._describe(stored, 0)
        self._check(header)
        body = self._assemble(header, offset, data, now)
        if body is None:
            return replace(self._head(), id=header.id, state="uploading", population=header.population)
        return self._accept(header, body)

    def _check(self, header: BatchHeader) -> None:
        """R31: what waits is bounded, and a refused batch leaves its id free."""
        size = self.run.settings.controller.size
        if header.size != size:
            raise BatchError(
                "malformed",
                f"the vectors have {plural(header.size, 'number')}, and a candidate of run {self._name} has {size}",
            )
        header.check_episodes(self._episodes(header))
        count, waiting = self._journal.batches.waiting()
        if count >= MAX_WAITING or waiting + header.total > MAX_WAITING_SIZE:
            raise BatchError("busy", f"{plural(count, 'batch', 'batches')} wait already: submit it again later")

    def _episodes(self, header: BatchHeader) -> int:
        return header.seeds or header.episodes or self.run.settings.episodes

    def _assemble(self, header: BatchHeader, offset: int, data: bytes, now: float) -> bytes | None:
        """The whole body, once all its parts are here."""
        key, sha256 = hashlib.sha256(header.id.encode() + header.content).digest(), bytes.fromhex(header.sha256)
        if offset % MAX_PART or len(data) != min(MAX_PART, header.total - offset) or not data:
            raise BatchError(
                "malformed",
                f"a part begins at a multiple of {MAX_PART} and has {MAX_PART} bytes, or those that are left",
            )
        before = self._uploads.dropped.copy()
        part = UploadPart(run_uid=self.run.uid, incarnation=self.run.incarnation, digest=key, sha256=sha256,
                          offset=offset, total=header.total, data=data)  # fmt: skip
        self._uploads.add(header.id, part, now)
        body = self._uploads.get_complete(header.id, key, sha256)
        if body is not None:
            self._uploads.forget(key)
        elif dropped := self._uploads.dropped - before:
            if TOO_MANY in dropped:
                raise BatchError("busy", "too many batches are being sent at once: submit it again later")
            raise BatchError("malformed", "the body has another SHA-256 than sha256 says: submit it again")
        return body

    def _accept(self, header: BatchHeader, body: bytes) -> BatchReply:
        vectors = body[8 * header.seeds :]
        seeds: Sequence[int] = unpack_seeds(header, body)
        check_vectors(vectors, header.size)
        if not seeds:
            first, number = self.run.settings.seed, self._journal.batches.count()
            seeds = [training_seed(first, number, each) for each in range(self._episodes(header))]
        if (remark := remark_on_seeds(seeds)) and not self._remarked:
            self._remarked = True
            log.warning("batch %s: %s", header.id, remark)
        self._journal.batches.add(header.id, header.content, seeds, header.population, vectors)
        batch = self._journal.batches.find(header.id)
        assert batch is not None
        return replace(self._describe(batch, 0), is_new=True)

    def _cancel(self, batch: StoredBatch) -> BatchReply:
        """Cancel a batch that waits or is being scored; a finished one stays as it is."""
        if batch.state not in FINAL:
            self._journal.batches.cancel(batch.id)
            if batch.generation is not None:
                self.run.generation.cancel()
                self.run.fleet.leases.withdraw(self.run.generation.unwanted)
        return self._describe(self._journal.batches.find(batch.id) or batch, 0)

    def _describe(self, batch: StoredBatch, offset: int) -> BatchReply:
        fitness, errors, done = self._page(batch, offset)
        return replace(
            self._head(), id=batch.id, state=batch.state, population=batch.population, episodes=len(batch.seeds),
            done=done, generation=batch.generation, offset=offset, **_fit(fitness, errors, offset),
        )  # fmt: skip

    def _page(self, batch: StoredBatch, offset: int) -> tuple[list[float | None], dict[int, str], int]:
        """Fitness from `offset` on, why some candidates have none, and how many candidates are done."""
        generations, generation = self.run.generations, self._open_generation
        limit = min(PAGE_CANDIDATES, max(batch.population - offset, 0))
        if batch.generation is None:
            if batch.state != "cancelled":
                return [None] * limit, {}, 0
            return [None] * limit, dict.fromkeys(range(offset, offset + limit), CANCELLED), batch.population
        if generation is None or batch.generation != generation.number:
            fitness = self._journal.batches.fitness_page(batch.generation, offset, limit)
            return fitness, dict(batch.errors), batch.population
        assert isinstance(generations, ExternalGenerations)
        scores = generation.candidate_scores(slice(offset, offset + limit))
        columns = zip(scores.fitness, scores.done, scores.wanted, strict=True)
        fitness = [value if done == wanted else None for value, done, wanted in columns]
        failed = [each for each in generation.without_fitness if offset <= each < offset + limit]
        for each in failed:
            fitness[each - offset] = None
        return fitness, generations.find_errors(generation, failed) if failed else {}, generation.candidates_done

    @property
    def _open_generation(self) -> Generation | None:
        """The open generation: while the journal cannot be written, as it is there, where there may be none."""
        if self.run.state.stalled is None:
            return self.run.generation
        stored = None if self._durable else self._journal.last_generation()
        if stored is not None and not self._journal.is_closed(stored.number):
            self._durable = self.run.generations.reload(stored.number)
        return self._durable

    def _head(self) -> BatchReply:
        run = self.run
        shown = shown_state(run)
        return BatchReply(v=keys.PROTOCOL_VERSION, run=self._name, size=run.settings.controller.size,
                          run_state=shown.word, run_why=truncate(shown.why, 1000))  # fmt: skip


def _fit(fitness: Sequence[float | None], errors: Mapping[int, str], offset: int) -> dict[str, Any]:
    """As much of a page as fits into a reply, one candidate at least."""
    left, kept, named = PAGE_BYTES, 0, []
    for index, value in enumerate(fitness, offset):
        found = None if index not in errors else CandidateError(index, truncate(errors[index], LONGEST_ERROR))
        left -= len(repr(value)) + 2 + (0 if found is None else 40 + len(json.dumps(found.error)))
        if left < 0 and kept:
            break
        kept += 1
        if found is not None:
            named.append(found)
    return {"fitness": tuple(fitness[:kept]), "errors": tuple(named)}
