"""Hosts whose bits may differ: which of them a run keeps, and what the others are told."""

import subprocess
import sys

import pytest

from dreamfleet.common import keys
from dreamfleet.common.codec import encode_json
from dreamfleet.common.messages import HelloRequest
from dreamfleet.common.runs import open_run
from dreamfleet.common.session import Network, open_session
from tests.support import tasks
from tests.support.processes import environment

pytestmark = pytest.mark.timeout(120)
OTHER = "riscv64 other"


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 2, "--evaluate-every", 0,
            "--task", tasks.SLOW_TOY)  # fmt: skip


@pytest.fixture
def stranger(processes, tmp_path):
    """Starts a worker on a host of another kind."""
    script, started = tmp_path / "stranger.py", []
    script.write_text(
        "import sys\nimport dreamfleet.worker.service.admission as admission, dreamfleet.worker.service.post as post\n"
        f"admission.fingerprint = post.fingerprint = lambda *_: {OTHER!r}\n"
        "from dreamfleet.common.cli import main\n"
        "if __name__ == '__main__':\n    sys.exit(main(sys.argv[1:]))\n"  # its children import it too
    )

    def start(*more):
        command = [sys.executable, script, "worker", "--connect", processes.endpoint, "--task", tasks.SLOW_TOY,
                   "--slots", "1", "--name", "stranger", *more]  # fmt: skip
        started.append(subprocess.Popen(command, env=environment(tmp_path / "c"), stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for each in started:
        each.kill()
        each.communicate()


def fingerprints(processes):
    with open_run(processes.runs, "test") as run:
        return {each.fingerprint for g in range(2) for i in range(4) for each in run.results(g, i)}


def test_a_host_that_said_hello_and_left_keeps_nobody_out(processes, settings):
    coordinator = processes.coordinator(*settings, "--generations", 2)
    hello = HelloRequest(
        keys.PROTOCOL_VERSION, keys.PROTOCOL_VERSION, "0", "gone/00000001", (tasks.SLOW_TOY,), OTHER, 1
    )
    with open_session(Network(connect=(processes.endpoint,))) as session:
        (reply,) = session.get(keys.hello("test"), payload=encode_json(hello), timeout=5)
        assert b'"accepted": true' in reply.ok.payload.to_bytes()
    processes.worker("--task", tasks.SLOW_TOY)
    assert coordinator.finish()[0] == 0
    assert OTHER not in fingerprints(processes)


def test_of_two_kinds_of_hosts_the_first_to_score_stays_and_the_other_is_told(processes, settings, stranger):
    coordinator = processes.coordinator(*settings, "--generations", 2)
    stranger()
    processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
    assert coordinator.finish(90)[0] == 0
    assert len(fingerprints(processes)) == 1
    assert any("fingerprints differ" in line for line in coordinator.lines)


def test_a_mixed_run_takes_both(processes, settings, stranger):
    coordinator = processes.coordinator(*settings, "--generations", 2, "--mixed")
    first = stranger()
    coordinator.wait_for("generation 0: mean")
    first.kill()
    processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
    assert coordinator.finish(90)[0] == 0
    assert len(fingerprints(processes)) == 2
