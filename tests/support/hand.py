"""A coordinator that a test drives by hand, with a real router and codec."""

import hashlib
import json
import queue
from contextlib import contextmanager
from dataclasses import asdict

import zenoh

from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode, decode_json, encode, encode_json
from dreamfleet.common.protocol.messages import (
    MAX_PART,
    TAG_BYTES,
    BundlePart,
    Heartbeat,
    HelloReply,
    HelloRequest,
    Intervals,
    JobBatch,
    ResultBatch,
    TaskSpec,
    UploadPart,
    Verdict,
)
from dreamfleet.common.transport.session import Network, open_session
from tests.support import samples
from tests.support.processes import DEADLINE

FIRST, SECOND = "aaaaaaaaaaaaaaaa", "bbbbbbbbbbbbbbbb"
SLOW_BEATS = Intervals(beat=60.0, repeat=0.1)  # the longest valid ones


class Hand:
    """Answers hello and bundle queries, and queues all messages of workers in order."""

    def __init__(self, port, bundle, task, run="test", beside=None):
        self.run = run
        self.spec = TaskSpec(task=task, bundle=bundle.sha256, horizon=100, patience=0)
        self.nonce, self.incarnation, self.run_uid = FIRST, 1, samples.UID
        self.numbering = 0  # of its batches; each accepted hello begins one
        self.intervals = Intervals(beat=0.1, repeat=0.1)
        self.refusal = None
        self.package = package_version("dreamfleet") or "unknown"  # its own version
        self.packages = NUMERIC_PACKAGES  # in the run's fingerprint
        self.worker = None
        self.slots = 0  # in its status
        self.answers = False  # whether it answers each heartbeat by an empty batch, as a coordinator does
        self.offsets = queue.SimpleQueue()  # of the requested parts of the bundle
        self.damage = lambda offset, data: data  # changes a part of the bundle; `None`: no answer
        self._held = []
        self._bundle = bundle.path.read_bytes()
        self.total = lambda: len(self._bundle)  # the announced size
        self._said = queue.SimpleQueue()
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self._shares = beside is not None  # another coordinator's router
        self.session = beside.session if self._shares else open_session(Network(listen=(self.endpoint,)))
        declare, answer = self.session.declare_subscriber, self.session.declare_queryable
        self._declared = [
            answer(keys.hello(run), direct(self._hello)),
            answer(keys.status(run), direct(self._status)),
            answer(keys.bundle(run, bundle.sha256), direct(self._part)),
            declare(keys.all_workers("result", run), self._hear(ResultBatch)),
            declare(keys.all_workers("beat", run), self._hear(Heartbeat)),
            declare(keys.all_workers("upload", run), self._hear(UploadPart)),
        ]
        self._token = None
        self.appear()

    def appear(self):
        self._token = self.session.liveliness().declare_token(keys.live_coordinator(self.run, self.nonce))

    def vanish(self):
        self._token.undeclare()

    def leave(self):
        """Vanish, and answer nothing more."""
        self.vanish()
        for each in self._declared:
            each.undeclare()

    def answer_no_hello(self):
        self._declared.pop(0).undeclare()

    def close(self):
        for query in self._held:
            query.drop()
        if not self._shares:
            self.session.close()

    def next(self, kind, accept=lambda _: True):
        """The next matching message of this kind; earlier messages are dropped."""
        while True:
            message = self._said.get(timeout=DEADLINE)
            if isinstance(message, kind) and accept(message):
                return message

    def hello(self):
        return self.next(HelloRequest)

    def beat(self, accept=lambda _: True):
        return self.next(Heartbeat, accept)

    def ready(self):
        self.hello()
        return self.beat(lambda beat: beat.capacity > 0)

    def result(self, of):
        """Wait for this job's result."""
        batch = self.next(ResultBatch, lambda batch: of.digest in _digests(batch))
        return next(each for each in batch.results if each.digest == of.digest)

    def results(self, *of):
        """Wait for the results of these jobs; digests of all results received."""
        missing, came = {job.digest for job in of}, set()
        while missing - came:
            came |= _digests(self.next(ResultBatch))
        return came

    def upload(self, of):
        """Wait for all parts of this job's file; return its bytes."""
        parts, total = {}, 1
        while sum(map(len, parts.values())) < total:
            part = self.next(UploadPart, lambda part: part.digest == of.digest)
            parts[part.offset], total = part.data, part.total
        data = b"".join(parts[offset] for offset in sorted(parts))
        assert hashlib.sha256(data).digest() == part.sha256
        return data

    def job(self, episode=0, kind="score"):
        return samples.job(episode, kind, spec=self.spec)

    def batch(self, number, *jobs, vectors=(samples.WHOLE,), cancels=(), accepted=(), ended=False, **head):
        verdicts = tuple(Verdict(job.digest, "accepted") for job in accepted)
        whole = {
            "run_uid": self.run_uid, "incarnation": self.incarnation, "nonce": self.nonce,
            "numbering": self.numbering, **head,
        }  # fmt: skip
        return JobBatch(**whole, number=number, vectors=vectors, jobs=jobs, cancels=cancels, verdicts=verdicts,
                        ended=ended)  # fmt: skip

    def send(self, number, *jobs, **content):
        self.put(encode(self.batch(number, *jobs, **content)))

    def put(self, payload):
        """Put a payload, which arrives: without BLOCK, Zenoh drops what follows a large one on a busy machine."""
        block = zenoh.CongestionControl.BLOCK
        self.session.put(keys.job(self.run, self.worker), payload, congestion_control=block)

    def _hear(self, kind):
        def hear(sample):
            self._said.put(decode(kind, sample.payload.to_bytes()))
            if kind is Heartbeat and self.answers:
                self.send(0, vectors=())

        return direct(hear)

    def _hello(self, query):
        with query:
            request = decode_json(HelloRequest, query.payload.to_bytes())
            self.worker = request.worker
            other = request.packages != self.packages
            why, remedy = self.refusal or (("other packages", "say hello again") if other else ("", ""))
            self.numbering += not why
            reply = HelloReply(
                accepted=not why, protocol_min=keys.PROTOCOL_VERSION, protocol_max=keys.PROTOCOL_VERSION,
                package=self.package, run=self.run, run_uid=self.run_uid, incarnation=self.incarnation,
                nonce=self.nonce, why=why, remedy=remedy,
                spec={} if why else asdict(self.spec), intervals={} if why else asdict(self.intervals),
                packages=self.packages, numbering=self.numbering,
            )  # fmt: skip
            query.reply(keys.hello(self.run), encode_json(reply), encoding="application/json")
        self._said.put(request)

    def _status(self, query):
        with query:
            document = {"run": self.run, "run_uid": self.run_uid, "state": "running", "slots": self.slots}
            query.reply(keys.status(self.run), json.dumps(document).encode(), encoding="application/json")

    def _part(self, query):
        offset = int(query.parameters.get("offset"))
        self.offsets.put(offset)
        data = self.damage(offset, self._bundle[offset : offset + MAX_PART])
        if data is None:
            self._held.append(query)
            return
        with query:
            part = BundlePart(
                run_uid=self.run_uid, incarnation=self.incarnation, sha256=bytes.fromhex(self.spec.bundle),
                offset=offset, total=self.total(), data=data,
            )  # fmt: skip
            query.reply(query.key_expr, encode(part))


@contextmanager
def unknown_sender(hand, key, answer):
    """Another session at the router of `hand`: it answers each query first, as if for all, by `answer(query)`."""

    def reply(query):
        with query:
            query.reply(query.key_expr, answer(query))

    with open_session(Network(connect=(hand.endpoint,))) as session:
        session.declare_queryable(key, reply, complete=True)
        yield


def _digests(batch):
    return {each.digest for each in batch.results}


def tag(job):
    return job.digest[:TAG_BYTES]


def direct(callback):
    return zenoh.handlers.Callback(callback, indirect=False)
