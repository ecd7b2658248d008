"""A share of the results is scored again on another host: who lies, or whose memory fails, is barred and recalled.

Tests common/protocol/check_counts.py, coordinator/run/verification.py, coordinator/verbs/bar.py,
common/security/host_key.py, coordinator/jobs/checks.py, coordinator/run/recall.py and
coordinator/storage/verification_records.py.
"""

import signal

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support.journals import change_journal
from tests.support.lying_tasks import LIES, WATCHED
from tests.support.processes import DEADLINE, ROOT, processes_in
from tests.support.same_bits import evolve, outcome


@pytest.fixture(scope="module")
def settings(small):
    return (*small, "--task", WATCHED, "--population", 8, "--episodes", 2, "--evaluate-every", 2,
            "--evaluation-episodes", 4, "--generations", 5)  # fmt: skip


DYING = """
import os, signal
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.storage.recall_records import RecallRecords

recall, commit = RecallRecords.recall, Run.commit

def dies_before(self, hosts):
    recall(self, hosts)
    self._journal.flush()
    os.kill(os.getpid(), signal.SIGKILL)

def dies_after(self):
    done = commit(self)
    if self.state.is_rewound:
        os.kill(os.getpid(), signal.SIGKILL)
    return done

if os.environ["DIES"] == "before":
    RecallRecords.recall = dies_before
else:
    Run.commit = dies_after
"""  # Python imports it as `sitecustomize` before the verb begins


def worker(processes, name, set_there=()):
    inside = ("env", *(f"{key}={value}" for key, value in dict(set_there).items())) if set_there else ()
    return processes.worker("--task", WATCHED, "--name", name, inside=inside)


def gathered(processes, coordinator, **hosts):
    """Workers on these hosts, which begin to score at one moment; what is set there makes a host lie."""
    assert processes.call("pause", "--connect", processes.endpoint)[0] == 0
    started = {name: worker(processes, name, set_there) for name, set_there in hosts.items()}
    coordinator.wait_for_event("joined", times=len(hosts))
    assert processes.call("resume", "--connect", processes.endpoint)[0] == 0
    return started


@pytest.fixture(scope="module")
def honest(tmp_path_factory, settings):
    """What the run comes to on one honest host."""
    with processes_in(tmp_path_factory.mktemp("honest")) as processes:
        return evolve(processes, "honest", 1, *settings, task=WATCHED)


def query(processes, text):
    return change_journal(processes.runs / "test", text)


@pytest.mark.slow
def test_a_host_whose_results_differ_is_barred_and_the_run_has_the_bits_of_an_honest_one(processes, settings, honest):
    coordinator = processes.coordinator(*settings, "--verify", 0.5)
    workers = gathered(processes, coordinator, own={}, other={}, bad={LIES: 0.5})
    assert coordinator.finish()[0] == 0
    workers["bad"].wait_for_event("refused")
    assert outcome(processes, "test") == honest
    with open_run(processes.runs, "test") as run:
        checks = run.checks
    assert checks.barred == ("bad",)
    assert checks.differing > 0
    assert query(processes, "SELECT count(*) FROM result WHERE worker LIKE 'bad/%'") == [(0,)]


@pytest.mark.slow
@pytest.mark.exact
def test_the_coordinators_own_host_decides_against_a_single_other_one(processes, settings, honest, tmp_path):
    """The own host's worker shows the key in the cache folder that it shares with the coordinator."""
    coordinator = processes.coordinator(*settings, "--verify", 1)
    gathered(processes, coordinator, own={}, bad={LIES: 0.5, "DREAMFLEET_CACHE": tmp_path / "elsewhere"})
    coordinator.wait_for_event("barred", worker="bad")
    assert coordinator.finish()[0] == 0
    assert outcome(processes, "test") == honest


@pytest.mark.long
@pytest.mark.exact
@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_coordinator_that_is_killed_amid_a_recall_goes_on_as_if_it_had_not_been(
    processes, settings, honest, moment, tmp_path
):
    """It dies with the recall written and not committed, or committed and not continued."""
    (tmp_path / "sitecustomize.py").write_text(DYING)
    inside = ("env", f"PYTHONPATH={ROOT}:{tmp_path}", f"DIES={moment}")
    dying = processes.coordinator(*settings, "--verify", 1, inside=inside)
    gathered(processes, dying, own={}, other={}, bad={LIES: 0.5})
    assert dying.popen.wait(DEADLINE) == -signal.SIGKILL
    recalled = query(processes, "SELECT count(*) FROM recalled") + query(processes, "SELECT count(*) FROM barred")
    assert (recalled == [(0,), (0,)]) == (moment == "before")
    assert processes.resume().finish()[0] == 0
    assert outcome(processes, "test") == honest
    with open_run(processes.runs, "test") as run:
        assert run.checks.barred == ("bad",)


@pytest.mark.slow
@pytest.mark.exact
def test_a_host_that_the_operator_bars_is_recalled_live_and_after_the_end(processes, settings, honest):
    """Nothing is checked: the operator knows it from elsewhere."""
    liars = {"bad": {LIES: 0.5}, "worse": {LIES: 0.9}}
    coordinator = processes.coordinator(*settings, "--generations", 2)
    first = gathered(processes, coordinator, own={}, **liars)
    assert coordinator.finish()[0] == 0
    for each in first.values():
        each.end()
    coordinator = processes.resume("test", "--generations", 5)
    coordinator.wait_for_event("begin")
    assert "bad" in processes.printed("bar", "bad", "--connect", processes.endpoint)
    coordinator.wait_for_event("recalled")
    worker(processes, "bad", liars["bad"]).wait_for_event("refused")
    gathered(processes, coordinator, own={}, worse=liars["worse"])
    assert coordinator.finish()[0] == 0
    assert outcome(processes, "test") != honest
    where = "test", "--runs-dir", processes.runs, "--connect", processes.endpoint
    code, _, err = processes.call("bar", "bed", *where)
    assert code == 2
    assert all(host in err for host in ("bad", "own", "worse"))
    assert "--resume test" in processes.printed("bar", "worse", *where)
    assert processes.resume().finish()[0] == 0
    assert outcome(processes, "test") == honest
    with open_run(processes.runs, "test") as run:
        assert run.checks.barred == ("bad", "worse")
        assert {each.worker for each in run.events() if each.what == "barred"} == {"bad", "worse"}
