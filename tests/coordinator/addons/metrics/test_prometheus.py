"""Prometheus's own parser on the exposition of a status; slow clients, and how long an ended run waits for its scraper.
Tests metrics_server.py."""

import json
import re
import select
import socket
import threading
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from dataclasses import replace

import pytest
from prometheus_client.parser import text_string_to_metric_families

from dreamfleet.common.client.status import Throughput
from dreamfleet.common.protocol.host_classes import MAX_LISTED, HostClasses
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.coordinator.addons.metrics import metrics_server
from dreamfleet.coordinator.addons.metrics.metrics_server import LONGEST, ScrapeTimes
from dreamfleet.coordinator.addons.metrics.prometheus import MAX_REASONS, MAX_WORKERS, exposition
from tests.support.processes import DEADLINE, ROOT, free_port, until
from tests.support.samples import STATUS
from tests.support.served import snapshot

GRAFANA = ROOT / "deploy" / "grafana" / "dreamfleet.json"
WORKER = replace(STATUS.worker_list[0], job_seconds=1.5, round_trip=0.02, resent=3)
WHOLE = replace(
    STATUS, worker_list=(WORKER,), limits={"minutes": 30.0}, throughput=Throughput(987.5, 448000, 60.0),
    confirmed=StoredConfirmation(4, 16, 118.5, 30.0, 7),
    generation=replace(STATUS.generation, temperature=1.25), classes=HostClasses.of({("a" * 16, "x"): 5}),
)  # fmt: skip
HOSTILE = 'a"b\\c\nd{run="x"} 1\x1b[2J\ud800'


def read(status):
    """Samples by name, each with its labels and value."""
    found = {}
    for family in text_string_to_metric_families(exposition(status).decode()):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def test_values_are_the_statuss():
    found = read(WHOLE)
    assert found["dreamfleet_generation"] == [({"run": "night"}, 7.0)]
    assert found["dreamfleet_environment_steps_total"][0][1] == 448000
    assert ({"run": "night", "of": "mean"}, 90.5) in found["dreamfleet_fitness"]
    assert ({"run": "night", "why": "reissued"}, 1.0) in found["dreamfleet_jobs_given_again_total"]
    assert found["dreamfleet_worker_job_seconds"] == [({"run": "night", "worker": "host-a/0a1b2c3d"}, 1.5)]
    assert [labels["state"] for labels, value in found["dreamfleet_state"] if value] == ["running"]
    assert found["dreamfleet_confirmed_score"][0][1] == 118.5


def test_unknown_values_and_the_error_of_a_score_of_one_episode_have_no_sample():
    found = read(replace(STATUS, last=None, recent=(), evaluation=None, best=None))
    for name in ("fitness", "evaluated_score", "confirmed_score", "temperature", "eta_seconds", "worker_job_seconds"):
        assert f"dreamfleet_{name}" not in found
    found = read(replace(STATUS, best=StoredEvaluation(4, 1, 120.5, 0.0)))
    assert found["dreamfleet_best_evaluated_score"][0][1] == 120.5
    assert "dreamfleet_best_evaluated_score_error" not in found
    assert found["dreamfleet_evaluated_score_error"][0][1] == STATUS.evaluation.error


def test_results_by_host_class_sum_to_the_total():
    found = read(replace(STATUS, classes=HostClasses.of({(f"{n:016x}", "x"): 10 - n for n in range(9)})))
    assert found["dreamfleet_host_classes"][0][1] == 9
    results = {labels["class"]: value for labels, value in found["dreamfleet_class_results"]}
    assert results == {**{f"{n:016x}": 10 - n for n in range(MAX_LISTED)}, "other": 6 + 5 + 4 + 3 + 2}


def test_label_sets_are_bounded():
    fleet = [replace(WORKER, worker=f"host-{number}/0a1b2c3d") for number in range(500)]
    dropped = {f"reason {number}": 1 for number in range(500)}
    found = read(replace(WHOLE, worker_list=tuple(fleet), dropped=dropped))
    assert len(found["dreamfleet_worker_slots"]) == MAX_WORKERS
    assert len(found["dreamfleet_dropped_messages_total"]) == MAX_REASONS


def test_untrusted_text_cannot_start_a_line():
    worker = replace(WORKER, worker=HOSTILE)
    hostile = replace(WHOLE, run=HOSTILE, worker_list=(worker,), dropped={HOSTILE: 1})
    found, plain = read(hostile), read(WHOLE)
    assert found.keys() == plain.keys()
    assert {name: len(samples) for name, samples in found.items()} == {name: len(each) for name, each in plain.items()}


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1.7e308])
def test_any_number_can_be_written(value):
    assert len(read(replace(WHOLE, last=replace(STATUS.last, mean=value)))["dreamfleet_fitness"]) == 3


def test_every_metric_of_the_grafana_dashboard_exists():
    dashboard = json.loads(GRAFANA.read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked += [each["query"] for each in dashboard["templating"]["list"]]
    names = {name for text in asked for name in re.findall(r"dreamfleet_[a-z_]+", text)}
    assert len(names) > 20
    assert names <= read(WHOLE).keys()
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])


def test_several_runs_share_each_metrics_head():
    text = exposition(WHOLE, replace(WHOLE, run="lucid", confirmed=None)).decode()
    heads = re.findall(r"^# TYPE (\S+)", text, re.MULTILINE)
    assert len(heads) == len(set(heads))
    families = {each.name: each for each in text_string_to_metric_families(text)}
    assert [each.labels["run"] for each in families["dreamfleet_generation"].samples] == ["night", "lucid"]
    assert [each.labels["run"] for each in families["dreamfleet_confirmed_score"].samples] == ["night"]
    assert exposition() == b""


def test_a_client_that_sends_a_byte_at_a_time_delays_neither_others_nor_the_end(monkeypatch):
    monkeypatch.setattr(metrics_server, "TIMEOUT", 0.5)
    port, over = free_port(), threading.Event()

    def drip():
        with socket.create_connection(("127.0.0.1", port)) as slow:
            slow.sendall(b"GET /metrics HTTP/1.1\r\n")
            begun.set()
            try:
                while not over.wait(0.1):
                    slow.sendall(b"X")
            except OSError:
                dropped.set()

    begun, dropped = threading.Event(), threading.Event()
    with metrics_server.serve_metrics(str(port), snapshot, lambda: True):
        thread = threading.Thread(target=drip)
        thread.start()
        assert begun.wait(DEADLINE)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=DEADLINE) as answer:
            assert b"dreamfleet_generation" in answer.read()
    assert dropped.wait(DEADLINE)
    over.set()
    thread.join()


def connect(port):
    return socket.create_connection(("127.0.0.1", port), timeout=DEADLINE)


def scrapes(port):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=DEADLINE) as answer:
            return b"dreamfleet_generation" in answer.read()
    except OSError:
        return False


def test_idle_connections_delay_no_scrape_however_many_there_are(monkeypatch):
    monkeypatch.setattr(metrics_server, "TIMEOUT", 2 * DEADLINE)
    monkeypatch.setattr(metrics_server, "MOST_CLIENTS", 12)
    port = free_port()
    with ExitStack() as stack, metrics_server.serve_metrics(str(port), snapshot, lambda: True):
        other = stack.enter_context(socket.create_connection(("127.0.0.1", port), DEADLINE, ("127.0.0.2", 0)))
        idle = [stack.enter_context(connect(port)) for _ in range(40)]
        for _ in range(2):
            assert scrapes(port)
        until(lambda: len(select.select(idle, [], [], 0)[0]) >= 40 - 12, "those that gave way are closed")
        assert select.select([other], [], [], 0)[0] == [], "another address holds fewer"
        for each in (*idle, other):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "10.0.0.1:9108", ""])
def test_a_page_whose_name_resolves_to_the_loopback_reads_no_metrics(host):
    port = free_port()
    request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers={"Host": host})
    with metrics_server.serve_metrics(str(port), snapshot, lambda: True):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(request, timeout=DEADLINE)
        refused.value.close()
        assert refused.value.code == 421
        for own in (f"localhost:{port}", "127.0.0.1"):
            request.add_header("Host", own)
            with urllib.request.urlopen(request, timeout=DEADLINE) as answer:
                assert answer.status == 200


def test_other_hosts_that_may_read_metrics_name_the_server_as_they_like():
    port = free_port()
    request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers={"Host": "coordinator.example"})
    with (
        metrics_server.serve_metrics(f"0.0.0.0:{port}", snapshot, lambda: True),
        urllib.request.urlopen(request, timeout=DEADLINE) as answer,
    ):
        assert answer.status == 200


def test_an_ended_run_waits_until_its_scraper_has_seen_the_end():
    scrapes = ScrapeTimes()
    assert not scrapes.is_expected(0.0, 0.0)
    scrapes.record("running", 0.0)
    assert not scrapes.is_expected(1.0, 1.0)  # a look by hand, perhaps
    scrapes.record("evaluating", 15.0)
    assert scrapes.is_expected(20.0, 49.0)
    assert not scrapes.is_expected(20.0, 50.0)
    scrapes.record("evaluating", 3600.0)
    assert scrapes.is_expected(3601.0, 3600.0 + LONGEST)
    assert not scrapes.is_expected(3601.0, 3601.0 + LONGEST), "a long interval is not waited for"
    scrapes.record("ended", 3610.0)
    assert not scrapes.is_expected(3601.0, 3610.0)
