"""A coordinator's log of its run: the summary line and the worker command."""

import dataclasses
import socket
from datetime import UTC, datetime, timedelta

from dreamfleet.common.client.status import EpisodeProgress, Throughput
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.service.run_log import summary, worker_command
from tests.support.samples import STATUS


def test_the_summary_shows_generation_score_speed_workers_and_time_left():
    status = dataclasses.replace(STATUS, limits={"minutes": 30.0}, throughput=Throughput(987.5, 448000, 1080.0))
    text, facts = summary(status)
    parts = "7: 3 of 8 episodes", "120.5 ± 7.8", "988 steps/s", "1 worker", "8 slots", "18 of 30 minutes", "12 min"
    assert [part for part in parts if part not in text] == []
    assert (facts["generation"], facts["workers"]) == (7, 1)
    assert summary(dataclasses.replace(STATUS, best=None))[1]["best"] is None


def test_the_summary_counts_failed_candidates():
    opened = dataclasses.replace(STATUS.generation, failed=1)
    text, facts = summary(dataclasses.replace(STATUS, failed=2, generation=opened))
    assert "3 failed candidates" in text
    assert facts["failed"] == 3


def test_no_generation_is_named_once_a_limit_is_reached():
    confirming = dataclasses.replace(STATUS, state="evaluating", ending=True, confirming=EpisodeProgress(3, 16))
    for status in (confirming, dataclasses.replace(STATUS, state="paused", ending=True)):
        assert "generation 7" not in summary(status)[0]
    assert "3 of 16 episodes" in summary(confirming)[0]


def test_the_worker_command_names_an_address_that_other_hosts_reach():
    assert worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "car-racing") == (
        "dreamfleet worker --run night --connect tcp/127.0.0.1:7447"
    )
    everywhere = worker_command(Network(listen=("tcp/0.0.0.0:7448", "tcp/[::]:7449")), "night", "car-racing")
    assert everywhere.endswith(f"--connect tcp/{socket.gethostname()}:7448 tcp/{socket.gethostname()}:7449")
    own = worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "field:FieldTask")
    assert own.endswith("--connect tcp/127.0.0.1:7447 --task field:FieldTask")
    assert "--task" not in worker_command(Network(listen=("tcp/127.0.0.1:7447",)), "night", "gym:CartPole-v1")
    assert "tcp/router:1" in worker_command(Network(connect=("tcp/router:1",)), "night", "car-racing")


def test_with_join_files_the_worker_command_names_the_workers_own():
    credentials = Credentials("coordinator", 1, "home", datetime.now(UTC) + timedelta(days=90), "")
    command = worker_command(Network(listen=("tls/0.0.0.0:7447",), credentials=credentials), "night", "car-racing")
    assert command == "dreamfleet worker --run night --join FILE"
