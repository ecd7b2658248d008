"""`/metrics` of a live coordinator."""

import urllib.error
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from dreamfleet.common.host.reports import ADDRESS
from tests.support import tasks
from tests.support.processes import DEADLINE, call_here, free_port
from tests.support.served import serving, snapshot

TOKEN = "correct horse battery"


def read(port, path="/metrics"):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=DEADLINE) as answer:
        text = answer.read().decode()
    return {sample.name: sample for family in text_string_to_metric_families(text) for sample in family.samples}


@pytest.mark.slow
def test_a_coordinator_answers_prometheus_and_a_taken_port_is_one_line(processes, small):
    port = free_port()
    settings = (*small, "--task", tasks.TOY, "--metrics-port", port)
    coordinator = processes.coordinator(*settings)
    assert read(port)["dreamfleet_generation"].value == 0
    processes.worker("--task", tasks.TOY, "--name", "host-a")
    coordinator.wait_for_event("generation", number=1)
    while (found := read(port))["dreamfleet_generations_closed_total"].value < 1:
        pass  # a snapshot is a fifth of a second old
    assert found["dreamfleet_worker_slots"].labels["worker"].startswith("host-a/")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        read(port, "/")
    other = f"tcp/127.0.0.1:{free_port()}"
    new = ("coordinator", "--run", "other", "--runs-dir", processes.runs, "--listen", other)
    code, _, err = processes.call(*new, *settings)
    assert (code, str(port) in err, "Traceback" in err) == (1, True, False), err
    for wrong in ("none", "0", "host:", "70000"):
        code, _, err = call_here(*new, "--metrics-port", wrong)
        assert (code, "--metrics-port" in err) == (2, True), err


def test_the_dashboard_answers_for_every_live_run_to_holders_of_the_token(processes):
    with serving(processes.endpoint, snapshot(workers=80), snapshot(name="lucid")):
        page = processes.start("dashboard", "--connect", processes.endpoint, "--port", 0, "--token", TOKEN)
        address = page.wait_for_report(ADDRESS)
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"{address}metrics", timeout=DEADLINE)
        asked = urllib.request.Request(f"{address}metrics", headers={"Authorization": f"Bearer {TOKEN}"})
        with urllib.request.urlopen(asked, timeout=DEADLINE) as answer:
            text = answer.read().decode()
    found = {each.name: each.samples for each in text_string_to_metric_families(text)}
    assert [each.labels["run"] for each in found["dreamfleet_generation"]] == ["lucid", "night"]
    assert sum(each.labels["run"] == "night" for each in found["dreamfleet_worker_slots"]) == 80, "not the head alone"
