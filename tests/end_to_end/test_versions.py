"""Workers and coordinators of other versions: those of this protocol work together, others get a remedy.

An older worker is played by messages as the first version of this protocol wrote them (`tests/common/golden`), of which
nothing changes but numbers and names: no codec of today's has a hand in it.
"""

import io
import json
import queue
import shutil
import subprocess
import tarfile
import time
from contextlib import contextmanager, suppress

import msgpack
import pytest
import zenoh

from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.monitoring.client import Client
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.processes import DEADLINE, ROOT, processes_in

GOLDEN = ROOT / "tests" / "common" / "golden"
GENERATIONS, POPULATION = 3, 4
SETTINGS = ("--task", tasks.TOY, "--population", POPULATION, "--episodes", 1, "--evaluate-every", 0,
            "--generations", GENERATIONS)  # fmt: skip
OLD, SINCE = "old/0a1b2c3d", {"protocol_min": 2, "protocol_max": 2}


def packed(name):
    return msgpack.unpackb((GOLDEN / f"{name}.v2.msgpack").read_bytes())


def document(name):
    return json.loads((GOLDEN / f"{name}.v1.json").read_text())


class OldWorker:
    """A worker of the first version of protocol 2, before classes of hosts, stages and rollouts on the wire."""

    def __init__(self, session):
        self._session = session
        self._batches = queue.SimpleQueue()
        hear = zenoh.handlers.Callback(lambda said: self._batches.put(said.payload.to_bytes()), indirect=False)
        self._listening = session.declare_subscriber(f"dreamfleet/v2/test/job/{OLD}", hear)
        self._token = session.liveliness().declare_token(f"dreamfleet/v2/test/live/worker/{OLD}")

    def hello(self, **changes):
        """What is answered to its hello."""
        request = {**document("hello-request"), "worker": OLD, "tasks": [tasks.TOY], "fingerprint": fingerprint(),
                   "slots": 1, **changes}  # fmt: skip
        (reply,) = self._session.get("dreamfleet/hello/test", payload=json.dumps(request), timeout=DEADLINE)
        return json.loads(reply.ok.payload.to_bytes())

    def join(self):
        self.welcome = self.hello(**SINCE)
        assert self.welcome["accepted"], self.welcome
        assert self.welcome["spec"].keys() == document("task-spec").keys()  # others it does not know
        self.seen, self.owed = 0, {}
        self._say()

    def work(self):
        """Take a batch, score what it holds, and say what is owed."""
        with suppress(queue.Empty):
            self._take(msgpack.unpackb(self._batches.get(timeout=0.2)))
        self._say()

    def _take(self, batch):
        assert batch.keys() == packed("job").keys()
        if batch["numbering"] > self.welcome["numbering"]:  # it was silent for too long
            self.join()
        if batch["number"] != self.seen + 1:  # it was sent again
            return
        self.seen += 1
        for verdict in batch["verdicts"]:
            assert verdict["verdict"] in ("accepted", "duplicate")
            self.owed.pop(verdict["digest"], None)
        for job in batch["jobs"]:
            assert job.keys() == packed("job")["jobs"][0].keys()
            self.owed[job["digest"]] = {**packed("result")["results"][0], "digest": job["digest"], "steps": 10,
                                        "fitness": float(job["candidate"])}  # fmt: skip

    def _say(self):
        welcome = self.welcome
        head = {name: welcome[name] for name in ("run_uid", "incarnation")}
        if self.owed:
            own = {"fingerprint": fingerprint(), "results": list(self.owed.values())}
            self._put("result", {**packed("result"), **head, **own})
        own = {"nonce": welcome["nonce"], "numbering": welcome["numbering"], "seen": self.seen, "capacity": 1,
               "slots": 1, "queued": [], "running": [], "unacked": [digest[:8] for digest in self.owed]}  # fmt: skip
        self._put("beat", {**packed("beat"), **head, **own})

    def _put(self, kind, message):
        self._session.put(f"dreamfleet/v2/test/{kind}/{OLD}", msgpack.packb(message))


@contextmanager
def old_worker(processes):
    with open_session(Network(connect=(processes.endpoint,))) as session:
        yield OldWorker(session)


def test_a_worker_of_this_protocols_first_version_is_welcomed_given_jobs_and_its_results_count(processes):
    coordinator = processes.coordinator(*SETTINGS, "--beat", 1)
    with old_worker(processes) as worker:
        worker.join()
        while coordinator.popen.poll() is None:
            worker.work()
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        fitness = [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]
        (share,) = run.classes.largest
    assert fitness == [[0.0, 1.0, 2.0, 3.0]] * GENERATIONS
    assert (share.results, share.host_class) == (GENERATIONS * POPULATION, class_from_fingerprint(fingerprint()))


def test_a_worker_joins_if_it_speaks_this_protocol_and_else_gets_a_remedy(processes):
    coordinator = processes.coordinator(*SETTINGS)
    with old_worker(processes) as worker, Client((processes.endpoint,)) as client:
        for first, last in ((1, 1), (3, 4), (2**60, 2**62)):
            reply = worker.hello(protocol_min=first, protocol_max=last)
            assert not reply["accepted"]
            assert f"speaks protocol {first} to {last}, this run {keys.PROTOCOL_VERSION}" in reply["why"]
            assert "install dreamfleet" in reply["remedy"]
            coordinator.wait_for(f"refused worker {OLD}: {reply['why']}")
            await_that(lambda why=reply["why"]: client.status().refused == {"old": why}, "its status does not say so")
        for first, last in ((1, 2), (2, 3), (2, 2)):
            assert worker.hello(protocol_min=first, protocol_max=last)["accepted"]
        await_that(lambda: not client.status().refused, "the status does not list it as refused")


def await_that(happens, why):
    deadline = time.monotonic() + DEADLINE
    while not happens():
        assert time.monotonic() < deadline, why
        time.sleep(0.05)


def version_of(commit, folder):
    """The tree of a commit, from this repository's history."""
    data = subprocess.run(["git", "-C", ROOT, "archive", commit], check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="module")
def first_of_this_protocol():
    """The commit that this version of the protocol began with."""
    said = f"^PROTOCOL_VERSION = {keys.PROTOCOL_VERSION}$"
    log = subprocess.run(["git", "-C", ROOT, "log", "--format=%H", "-G", said, "--", "common/protocol/keys.py"],
                         check=False, capture_output=True, text=True)  # fmt: skip
    if not (found := log.stdout.split()):
        pytest.skip("the history of this repository is not here")
    return found[-1]


@pytest.fixture
def older(first_of_this_protocol, tmp_path):
    return version_of(first_of_this_protocol, tmp_path / "older")


@pytest.fixture
def before(first_of_this_protocol, tmp_path):
    return version_of(f"{first_of_this_protocol}~1", tmp_path / "before")


def scored(processes, coordinators, workers):
    """What a run of a coordinator and a worker of these versions comes to."""
    coordinator = processes.coordinator(*SETTINGS, root=coordinators)
    processes.worker("--task", tasks.TOY, "--run", "test", root=workers)
    assert coordinator.finish()[0] == 0, "".join(coordinator.lines)
    with open_run(processes.runs, "test") as run:
        return [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]


@pytest.mark.long
def test_the_first_version_of_this_protocol_and_todays_work_for_each_other_to_the_same_bits(older, tmp_path):
    found = []
    for number, versions in enumerate([(ROOT, ROOT), (ROOT, older), (older, ROOT)]):
        (tmp_path / str(number)).mkdir()
        with processes_in(tmp_path / str(number)) as processes:
            found.append(scored(processes, *versions))
    assert found[0] == found[1] == found[2]


@pytest.mark.long
def test_the_version_before_this_protocol_and_todays_refuse_each_other_and_say_what_to_do(processes, before):
    for coordinators, workers in ((ROOT, before), (before, ROOT)):
        coordinator = processes.coordinator(*SETTINGS, root=coordinators, name="test")
        worker = processes.worker("--task", tasks.TOY, "--run", "test", "--exit-when-done", root=workers)
        assert worker.finish()[0] == 1
        assert "speaks protocol" in worker.lines[-1]
        assert "install dreamfleet" in worker.lines[-1]
        coordinator.end()
        shutil.rmtree(processes.runs)
