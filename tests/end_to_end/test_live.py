"""Watching a live run: real coordinator, real workers, viewers that come, stay too long, and lie.
Tests common/addons/frames/live.py, worker/addons/live/verb.py, worker/service/frame_publisher.py and
worker/service/frame_sampler.py."""

import json
import signal

import msgspec
import pytest

from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, JournalError, UsageError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.messages import ViewFrame
from dreamfleet.common.runs.lookup import find_evaluated_mean
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import ROOT
from tests.support.samples import MSGPACK


@pytest.fixture
def run(processes, small):
    """A run with a worker of one slot; its coordinator."""
    coordinator = processes.coordinator(*small, "--task", tasks.PAINTED)
    coordinator.worker = processes.worker("--task", tasks.PAINTED, "--name", "first")
    return coordinator


def sights(view, count):
    """So many, waited for."""
    seen = []
    while len(seen) < count:
        if (sight := view.next(1.0)) is not None:
            seen.append(sight)
    return seen


@pytest.mark.slow
def test_a_view_follows_any_worker_that_is_there_and_one_of_a_chosen_worker_ends_with_it(processes, run):
    with Client((processes.endpoint,)) as client, LiveView(client) as view:
        seen = sights(view, 5)
        assert {each.worker.split("/")[0] for each in seen} == {"first"}
        assert all((each.picture == each.frame.step).all() for each in seen)
        second = processes.worker("--task", tasks.PAINTED, "--name", "second")
        while len(client.workers("test")) < 2:
            pass
        with LiveView(client, "test", "second") as other:
            assert sights(other, 2)[0].worker.startswith("second/"), "it has what the first one has not"
            run.worker.popen.kill()
            while not sights(view, 1)[0].worker.startswith("second/"):
                pass
            second.popen.kill()
            with pytest.raises(ConnectionFailedError, match="second"):
                sights(other, 1000)


@pytest.mark.slow
def test_who_is_not_there_is_named_and_a_coordinator_that_is_killed_is_missed(processes, run):
    with Client((processes.endpoint,)) as client:
        with pytest.raises(ConnectionFailedError, match=r"'other'.* test\b"):
            LiveView(client, "other")
        with LiveView(client) as view:
            worker = sights(view, 1)[0].worker
            with pytest.raises(UsageError, match=f"'nobody'.* {worker}"):
                LiveView(client, "test", "nobody")
            run.popen.kill()
            with pytest.raises(ConnectionFailedError, match="'test'"):
                sights(view, 1000)


@pytest.mark.slow
def test_hostile_frames_are_dropped_and_counted(processes, run):
    with Client((processes.endpoint,)) as client, LiveView(client) as view:
        (sight,) = sights(view, 1)
        own = {**msgspec.structs.asdict(MSGPACK["view"]), "run_uid": sight.frame.run_uid, "incarnation": 1}
        payloads = [
            bytes(60_000), b"\xc1", encode(MSGPACK["view"]),
            encode(ViewFrame(**{**own, "height": 200, "width": 200})), encode(ViewFrame(**{**own, "packed": True})),
            encode(ViewFrame(**{**own, "latent": b"\0\0\xc0\x7f"})),
        ]  # fmt: skip
        for number, payload in enumerate(payloads, start=1):
            while len(view.dropped.dropped) < number:  # each for its own reason; the worker's own frames come between
                client.session.put(keys.view("test", sight.worker), payload)
                view.next(0.05)
        assert len(sights(view, 3)) == 3


@pytest.mark.slow
def test_the_verb_writes_its_frames_when_it_is_stopped(processes, run, tmp_path):
    live = processes.start("live", "--connect", processes.endpoint, "--out", tmp_path / "stills", "--json")
    live.wait_for("test")
    while len(list((tmp_path / "stills").glob("*.png"))) < 3:
        pass
    code, out = live.stop(signal.SIGINT)
    assert code == 0
    assert json.loads(out)["pictures"] >= 3


@pytest.mark.slow
def test_the_verb_ends_with_the_run_and_says_how_that_ended(processes, small, tmp_path):
    coordinator = processes.coordinator(*small, "--task", tasks.PAINTED, "--generations", 1)
    live = processes.start("live", "--connect", processes.endpoint, "--out", tmp_path / "live.mp4")
    live.wait_for("test")
    processes.worker("--task", tasks.PAINTED)
    assert coordinator.finish()[0] == 0
    live.wait_for("1 generation")
    code, out = live.finish()
    assert (code, (tmp_path / "live.mp4").stat().st_size > 1000) == (0, True), out


def test_what_cannot_be_shown_is_said_in_one_line(processes, tmp_path):
    for flags, said in (
        (("--controller", "tiny"), "--out"),
        (("--controller", "tiny", "--run", "x", "--out", tmp_path / "a"), "--controller"),
        (("--generation", 3, "--out", tmp_path / "a"), "--controller"),
        (("--fps", 0), "--fps"),
        (("--controller", "nothing", "--out", tmp_path / "a"), "'nothing'"),
        (("--controller", "gone", "--generation", 3, "--out", tmp_path / "a"), "'gone'"),
        (("--connect", "tcp/127.0.0.1:9", "--out", tmp_path / "a"), "tcp/127.0.0.1:9"),
    ):
        code, _, err = processes.call("live", "--runs-dir", processes.runs, *flags)  # here a test may draw unseen
        assert (code != 0, said in err.splitlines()[-1], "Traceback" in err) == (True, True, False), err


def test_an_old_generations_mean_is_found_in_the_journal_and_one_that_was_not_evaluated_is_named():
    runs = ROOT / "tests" / "fixtures" / "runs"
    with open_run(runs, "dream") as run:
        evaluated = run.evaluations()[0].generation
        mean, beside = find_evaluated_mean("dream", runs, evaluated)
        assert (mean.parameters == run.evaluated_mean(evaluated)).all()
        assert (mean.bundle, beside) == (run.spec.bundle, run.bundle_path)
    with pytest.raises(JournalError, match=rf" 77 .*{evaluated}"):
        find_evaluated_mean("dream", runs, 77)
