"""What fifty open pages cost a run, in alternating blocks with none and with all of them."""

import re
import threading
import time
import urllib.request
from contextlib import ExitStack, contextmanager
from statistics import median

import pytest

from dreamfleet.common.client import Client
from tests.support import tasks

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
PAGES, BLOCKS, SECONDS = 50, 6, 10.0


def read(stream, frames):
    """As a page does: every event, as it comes."""
    try:
        for line in stream:
            frames.append(line.startswith(b"event: frame"))
    except (OSError, ValueError):
        pass  # it was closed


@contextmanager
def open_pages(address):
    """So many streams, each read by a thread; how many frames each got."""
    with ExitStack() as stack:
        frames = [[] for _ in range(PAGES)]
        for each in frames:
            stream = stack.enter_context(urllib.request.urlopen(f"{address}live", timeout=30))
            threading.Thread(target=read, args=(stream, each), daemon=True).start()
        yield frames


def steps_in_a_block(client):
    """Environment steps a second that counted."""
    began, before = time.monotonic(), client.status("test").throughput.environment_steps
    time.sleep(SECONDS)
    return (client.status("test").throughput.environment_steps - before) / (time.monotonic() - began)


def test_fifty_pages_do_not_slow_a_run(processes, random_bundle):
    processes.coordinator(
        "--bundle", random_bundle.path, "--population", 32, "--episodes", 4, "--evaluate-every", 0,
        "--task", tasks.SLOW_TOY, "--generations", 10**6,
    )  # fmt: skip
    processes.worker("--task", tasks.SLOW_TOY)
    started = processes.start("dashboard", "--connect", processes.endpoint, "--runs-dir", processes.runs, "--port", 0)
    address = re.search(r"http://\S+", started.wait_for("the dashboard is at")).group()
    alone, watched = [], []
    with Client((processes.endpoint,)) as client:
        while client.status("test").generations < 1:
            time.sleep(0.1)
        for _ in range(BLOCKS):
            alone.append(steps_in_a_block(client))
            with open_pages(address) as frames:
                watched.append(steps_in_a_block(client))
            assert min(map(sum, frames)) >= SECONDS / 2, "every page was served"
    share = median(watched) / median(alone)
    assert share > 0.99, (alone, watched)
