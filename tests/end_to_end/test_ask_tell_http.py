"""Batches over HTTP: the bridge's answers to good and bad requests, and to connections that stop.

Tests coordinator/addons/bridge/app.py, coordinator/addons/bridge/changes.py,
coordinator/addons/bridge/openapi.py
and coordinator/addons/bridge/verb.py.
"""

import base64
import json
import math
import re
import socket
import struct
import subprocess
import sys
from contextlib import ExitStack
from time import monotonic

import httpx2
import pytest

from dreamfleet import RemoteScorer
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.coordinator.addons.bridge.app import MOST_STREAMS
from tests.support import tasks
from tests.support.access import begin as begin_secured
from tests.support.access import work
from tests.support.batches import begin, count_results, vectors
from tests.support.processes import DEADLINE, ROOT, free_port

TOKEN = "0123456789abcdef0123456789abcdef"


class Bridge:
    """A bridge in a process of its own, and requests to it."""

    def __init__(self, processes, *more, token=None, inside=()):
        self.process = processes.start("serve", "--connect", processes.endpoint, "--port", 0, *more, inside=inside)
        self.address = self.process.wait_for_report(ADDRESS)
        self.port = int(self.address.rpartition(":")[2])
        self.token = token

    def to(self, path, **headers):
        """Where a request goes, and what stands in its head."""
        named = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        headers = {"Content-Type": "application/json", **named, **headers}
        return {"url": self.address + path, "headers": headers, "timeout": DEADLINE}

    def ask(self, method, path, body=None, **headers):
        """Status and parsed body of an answer."""
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        answer = httpx2.request(method, **self.to(path, **headers), content=data)
        return answer.status_code, answer.json()

    def submit(self, body, run="test", **headers):
        return self.ask("POST", f"/v1/runs/{run}/batches", body, **headers)

    def batch(self, name, run="test"):
        return self.ask("GET", f"/v1/runs/{run}/batches/{name}")

    def events(self, name, run="test"):
        """Yield kind and data of a batch's events."""
        with httpx2.stream("GET", **self.to(f"/v1/runs/{run}/batches/{name}/events")) as answer:
            kind = None
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if name == "event":
                    kind = value
                elif name == "data":
                    yield kind, json.loads(value)


@pytest.fixture
def bridge(processes, random_bundle):
    begin(processes, random_bundle)
    processes.worker("--task", tasks.TOY)
    return Bridge(processes)


def rows(count, first=0.0):
    return vectors(count, first).tolist()


def test_a_batch_is_submitted_followed_read_and_kept(processes, bridge):
    assert bridge.ask("GET", "/v1/health")[1]["status"] == "ok"
    [run] = bridge.ask("GET", "/v1/runs")[1]["runs"]
    assert (run["run"], run["external"], run["size"]) == ("test", True, 867)
    wanted = {"id": "a", "vectors": rows(3), "seeds": [1, 2]}
    status, made = bridge.submit(wanted)
    assert (status, made["population"], made["episodes"]) == (201, 3, 2)
    events = list(bridge.events("a"))
    assert [kind for kind, _ in events] == ["candidate"] * 3 + ["end"]
    assert events[-1][1]["state"] == "complete"
    status, found = bridge.batch("a")
    assert status == 200
    assert found["fitness"] == [each["fitness"] for _, each in sorted(events[:3], key=lambda each: each[1]["index"])]
    assert all(map(math.isfinite, found["fitness"]))
    again = {**made, "state": "complete", "done": 3, "generation": 0, "run_state": "waiting for a batch"}
    assert bridge.submit(wanted) == (200, again)
    assert bridge.ask("DELETE", "/v1/runs/test/batches/a")[1]["state"] == "complete"
    assert bridge.submit({"id": "a", "vectors": rows(3), "seeds": [1, 3]})[0] == 409
    assert count_results(processes)[0] == 6
    packed = {"float32": base64.b64encode(vectors(3).tobytes()).decode(), "size": 867}
    assert bridge.submit({"id": "b", "vectors": packed, "seeds": [1, 2]})[0] == 201
    assert bridge.submit({"id": "b", "vectors": rows(3), "seeds": [1, 2]})[0] == 200  # the same content
    assert [*bridge.events("b")][-1][1]["done"] == 3
    assert bridge.batch("b")[1]["fitness"] == found["fitness"]
    assert count_results(processes)[0] == 6
    listed = bridge.ask("GET", "/v1/runs/test/batches")[1]["batches"]
    assert [(each["id"], each["state"], each["population"]) for each in listed] == [
        ("b", "complete", 3), ("a", "complete", 3),
    ]  # fmt: skip
    status, drawn = bridge.submit({"vectors": rows(2)})
    assert status == 201
    assert drawn["id"]


@pytest.mark.slow
def test_bad_requests_are_refused_and_lose_nothing(bridge):
    good = {"id": "b", "vectors": rows(1), "seeds": [1]}
    text, first = json.dumps(good), good["vectors"][0][1:]
    packed = {"float32": base64.b64encode(vectors(1).tobytes()).decode(), "size": 867}
    wrong = [b"{", b"[" * 100_000, b"\xff\xfe", b'{"vectors": [[NaN]]}', [], text.encode("utf-16")]
    wrong += [f'{text[:-1]}, "id": "b"}}'.encode(), text.replace("{", '{"seeds": [2], ', 1).encode()]  # said twice
    for name, values in {
        "vectors": (
            [], "a", [[]], [[1.0] * 12], [["a"] * 867], [[1e39] * 867], [["1.5", *first]], [[True, *first]],
            [[None, *first]], {"float32": "AAAAAA=="}, {"float32": "?", "size": 1}, {"float32": "AAAA", "size": 867},
            {"float32": 7, "size": 1}, {"float32": "AAAAAA==", "size": 0}, {"float32": "AAAAAA==", "size": "a"},
            {**packed, "size": True}, {**packed, "size": "867"},
        ),
        "seeds": ([-1], "1", ["1"], [True], None, [], [1.5]), "episodes": (0, True, 2),
        "id": ("", None, 7, "a/b"), "more": (1,),
    }.items():  # fmt: skip
        wrong += [{**good, name: value} for value in values]
    for body in wrong:
        status, answer = bridge.submit(body)
        assert (status, answer["error"]) == (400, "malformed"), (str(body)[:80], answer)
    large = {**good, "vectors": [[0] * 1000] * 10_000}
    for body in (large, {**large, "id": "float32"}, b" " * (65 << 20)):
        assert bridge.submit(body)[0] == 413
    assert bridge.submit(good, **{"Content-Type": "text/plain"})[0] == 415
    assert bridge.submit(good, run="nobody")[0] == 404
    assert bridge.submit(good, run="a%20b")[0] == 400
    assert bridge.batch("other")[0] == 404
    assert bridge.ask("GET", "/v1/runs/test/batches/other/events")[0] == 404
    assert bridge.ask("DELETE", "/v1/runs/test/batches/other")[0] == 404
    assert bridge.ask("PUT", "/v1/runs/test/batches", {})[0] == 405
    assert bridge.ask("GET", "/v2")[0] == 404
    assert bridge.submit(good, Host="evil.example")[0] == 421
    assert bridge.submit(good, **{"Sec-Fetch-Site": "cross-site"})[0] == 403
    assert bridge.submit(good)[0] == 201  # none of these took its id


IMPATIENT = """
from dreamfleet.coordinator.addons.bridge import app, verb
from dreamfleet.coordinator.addons.web import server as web

app.BODY_TIMEOUT, web.IDLE_TIMEOUT, verb.KEEP_ALIVE = 3.0, 1.0, 4
"""  # Python imports it as `sitecustomize` before the verb begins


@pytest.mark.slow
def test_garbage_and_half_open_connections_hold_nobody_up(processes, random_bundle, tmp_path):
    begin(processes, random_bundle)
    processes.worker("--task", tasks.TOY)
    (tmp_path / "sitecustomize.py").write_text(IMPATIENT)
    bridge = Bridge(processes, inside=("env", f"PYTHONPATH={ROOT}:{tmp_path}"))

    def connect(data):
        made = socket.create_connection(("127.0.0.1", bridge.port), timeout=DEADLINE)
        made.sendall(data)
        return made

    head = b"POST /v1/runs/test/batches HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    stalled = [
        connect(head + b"Content-Length: 1000\r\n\r\n{"),
        connect(head),
        connect(b""),
        connect(b"\x16\x03\x01\xff"),
    ]
    broken = connect(head + b"Content-Length: 1000\r\n\r\n{")
    broken.close()
    assert bridge.submit({"id": "a", "vectors": rows(1), "seeds": [1]})[0] == 201
    assert [kind for kind, _ in bridge.events("a")][-1] == "end"
    answers = []
    for each in stalled:  # each is closed from the other side, in time
        received, part, since = b"", b" ", monotonic()
        while part and monotonic() < since + DEADLINE:
            each.settimeout(0.5)
            try:
                received += (part := each.recv(4096))
            except TimeoutError:
                each.sendall(b" " * (each is stalled[0]))  # slowly: it keeps no place that others need
        answers.append(received.split(b"\r\n")[0])
        each.close()
    assert b"408" in answers[0]
    assert b"400" in answers[3]
    assert bridge.batch("a")[1]["state"] == "complete"


def test_a_token_is_needed_where_there_is_one(processes, random_bundle, tmp_path):
    begin(processes, random_bundle)
    file = tmp_path / "tokens"
    file.write_text(f"# for tests\n{TOKEN}\n{TOKEN[::-1]}\n")
    processes.refused(str(file), "serve", "--connect", processes.endpoint, "--token-file", file, "--port", 0)
    file.chmod(0o600)
    assert processes.call("serve", "--host", "0.0.0.0")[0] == 2
    bridge = Bridge(processes, "--token-file", file)
    for wrong in (None, TOKEN[:-1], TOKEN + "0", "x"):
        bridge.token = wrong
        for method, path in (("GET", "/v1/runs"), ("GET", "/openapi.json"), ("POST", "/v1/runs/test/batches"),
                             ("GET", "/v1/runs/test/batches/a"), ("DELETE", "/v1/runs/test/batches/a"),
                             ("GET", "/v1/runs/test/batches/a/events")):  # fmt: skip
            assert bridge.ask(method, path)[0] == 401
        assert bridge.ask("GET", "/v1/health")[0] == 200
    for right in (TOKEN, TOKEN[::-1]):
        bridge.token = right
        assert bridge.ask("GET", "/v1/runs")[0] == 200


def described_for_the_run(described):
    """The description with what only the run knows: its name, and the size of its vectors."""
    for way in (way for path in described["paths"].values() for way in path.values()):
        for each in way.get("parameters", ()):
            if each["name"] == "run":
                each["schema"] = {"anyOf": [{"const": "test"}, each["schema"]]}
    numbers, packed = described["components"]["schemas"]["Submission"]["properties"]["vectors"]["oneOf"]
    numbers["items"] |= {"minItems": 10, "maxItems": 10}
    packed["properties"]["float32"]["enum"] = [base64.b64encode(bytes(40)).decode()]
    packed["properties"]["size"]["const"] = 10
    return described


@pytest.mark.slow
def test_schemathesis_finds_no_broken_promise_in_the_description(processes, tmp_path):
    processes.coordinator("--task", "gym:CartPole-v1", "--optimiser", "external")
    processes.worker()
    bridge = Bridge(processes)
    described = described_for_the_run(bridge.ask("GET", "/openapi.json")[1])
    path = tmp_path / "openapi.json"
    path.write_text(json.dumps(described))
    done = subprocess.run(
        [sys.executable, "-m", "schemathesis.cli", "run", path, "--url", bridge.address, "--phases", "coverage,fuzzing",
         "--checks", "all", "--max-examples", "3", "--seed", "1", "--no-color"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=DEADLINE,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_seeds_outside_the_usual_range_are_remarked_and_too_many_refused(processes, random_bundle):
    begin(processes, random_bundle)
    bridge = Bridge(processes)
    packed = {"float32": base64.b64encode(vectors(1).tobytes()).decode(), "size": 867.0}
    status, first = bridge.submit({"id": "b", "vectors": rows(1), "seeds": [2**20, 10_000, 19_999]})
    assert (status, re.findall(r"\b[23]\b", first["remark"])) == (201, ["2", "3"])
    assert bridge.submit({"id": "c", "vectors": packed, "seeds": [9_999.0, 20_000]})[1]["remark"] == ""
    assert bridge.submit({"id": "d", "vectors": rows(1), "seeds": [*range(2**20, 2**20 + 10_000)]})[0] == 201
    assert bridge.submit({"id": "e", "vectors": rows(1), "episodes": 10_001})[0] == 400


@pytest.mark.slow
def test_the_bridge_may_start_before_its_coordinator(processes, random_bundle):
    process = processes.start("serve", "--connect", processes.endpoint, "--port", 0)
    process.wait_for("WARNING")
    begin(processes, random_bundle)
    process.wait_for("http://")
    stopped = processes.start("serve", "--connect", f"tcp/127.0.0.1:{free_port()}", "--port", 0)
    stopped.wait_for("WARNING")
    assert stopped.stop()[0] == 0


def test_malformed_requests_fill_no_log(processes):
    processes.start("router", "--listen", processes.endpoint).wait_for(processes.endpoint)
    bridge = Bridge(processes)
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", bridge.port), timeout=DEADLINE) as made:
            made.sendall(b"\x16\x03\x01\xff\r\n\r\n")
            assert b"400" in made.recv(4096)
    bridge.process.stop()
    assert sum("WARNING" in line for line in bridge.process.lines) == 1


@pytest.mark.slow
def test_streams_are_counted_where_they_are_opened(processes, random_bundle):
    begin(processes, random_bundle)
    bridge = Bridge(processes)
    assert bridge.submit({"id": "a", "vectors": rows(1), "seeds": [1]})[0] == 201  # nobody scores it
    request = f"GET /v1/runs/test/batches/a/events HTTP/1.1\r\nHost: 127.0.0.1:{bridge.port}\r\n\r\n".encode()
    with ExitStack() as stack:
        opened = [
            stack.enter_context(socket.create_connection(("127.0.0.1", bridge.port), timeout=DEADLINE))
            for _ in range(MOST_STREAMS + 8)
        ]
        for each in opened:
            each.sendall(request)
        answers = [each.recv(12) for each in opened]
        assert answers.count(b"HTTP/1.1 200") == MOST_STREAMS
        assert answers.count(b"HTTP/1.1 503") == 8
    assert bridge.ask("DELETE", "/v1/runs/test/batches/a")[0] == 200
    assert [kind for kind, _ in bridge.events("a")][-1] == "end"  # those that left are not counted


@pytest.mark.slow
def test_clients_that_leave_the_stream_of_a_large_batch_cost_others_nothing(bridge):
    many = 2500  # some pages
    packed = {"float32": base64.b64encode(vectors(many).tobytes()).decode(), "size": 867}
    assert bridge.submit({"id": "a", "vectors": packed, "seeds": [1]})[0] == 201
    found = [*bridge.events("a")]
    assert [kind for kind, _ in found] == ["candidate"] * many + ["end"]
    request = f"GET /v1/runs/test/batches/a/events HTTP/1.1\r\nHost: 127.0.0.1:{bridge.port}\r\n\r\n".encode()
    said = len(bridge.process.lines)
    for _ in range(20):
        with socket.socket() as leaving:
            leaving.settimeout(DEADLINE)
            leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it is cut off
            leaving.connect(("127.0.0.1", bridge.port))
            leaving.sendall(request)
            while b"event: candidate" not in leaving.recv(100):
                pass
    assert bridge.ask("GET", "/v1/health")[0] == 200
    again = [*bridge.events("a")]  # in order, as all were done
    assert again == [*sorted(found[:-1], key=lambda each: each[1]["index"]), found[-1]]
    assert len(bridge.process.lines) - said < 20


@pytest.mark.slow
def test_a_killed_coordinator_answers_503_and_its_batches_go_on(processes, random_bundle):
    coordinator = begin(processes, random_bundle, task=tasks.SLOW_TOY)
    processes.worker("--task", tasks.SLOW_TOY)
    bridge = Bridge(processes)
    wanted = {"id": "mine", "vectors": rows(12), "seeds": [1, 2]}
    assert bridge.submit(wanted)[0] == 201
    events = bridge.events("mine")
    first = next(events)
    coordinator.end()
    assert bridge.submit(wanted)[0] == 503
    processes.resume().wait_until_serving()
    found = [first, *events]
    assert sorted(each["index"] for kind, each in found if kind == "candidate") == [*range(12)]
    assert found[-1][0] == "end"
    assert bridge.submit(wanted)[0] == 200
    assert count_results(processes) == (24, 240)


@pytest.mark.slow
def test_a_secured_fleet_needs_an_operators_file(processes, access, endpoint, random_bundle):
    begin_secured(processes, access, endpoint, random_bundle, "--optimiser", "external")
    work(processes, access, endpoint, "first")
    for who in ("viewer", "second"):
        assert processes.call("serve", "--join", access.path(who), "--connect", endpoint, "--port", 0)[0] == 1
        with RemoteScorer(access.network(who, endpoint), "safe", timeout=0.0) as other:
            for ask in (lambda: other.submit(vectors(1)), lambda: other.find("a")):
                with pytest.raises(ConnectionFailedError):
                    ask()
    processes.endpoint = endpoint
    bridge = Bridge(processes, "--join", access.path("operator"))
    assert bridge.submit({"id": "a", "vectors": rows(2), "seeds": [1]}, run="safe")[0] == 201
    assert [*bridge.events("a", run="safe")][-1][1]["state"] == "complete"
