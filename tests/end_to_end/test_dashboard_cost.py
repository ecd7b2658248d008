"""What fifty open pages cost a run, in alternating blocks with none and with all of them."""

import socket
import threading
import time
from contextlib import contextmanager
from statistics import median

import pytest

from dreamfleet.common.client.client import Client
from tests.support import tasks
from tests.support.browser import dashboard

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
PAGES, BLOCKS, SECONDS = 50, 5, 8.0


def read(connection, frames):
    """As a page does: every event, as it comes, until the connection is shut."""
    with connection.makefile("rb") as stream:
        for line in stream:
            frames.append(line.startswith(b"event: frame"))


@contextmanager
def open_pages(port):
    """So many streams, each read by a thread; how many frames each got."""
    frames = [[] for _ in range(PAGES)]
    connections = [socket.create_connection(("127.0.0.1", port)) for _ in frames]
    readers = [threading.Thread(target=read, args=each) for each in zip(connections, frames, strict=True)]
    for connection, reader in zip(connections, readers, strict=True):
        connection.sendall(b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        reader.start()
    yield frames
    for connection, reader in zip(connections, readers, strict=True):
        connection.shutdown(socket.SHUT_RDWR)
        reader.join()
        connection.close()


def steps_in_a_block(client):
    """Environment steps a second that counted."""
    began, before = time.monotonic(), client.status("test").throughput.environment_steps
    time.sleep(SECONDS)
    return (client.status("test").throughput.environment_steps - before) / (time.monotonic() - began)


def test_fifty_pages_do_not_slow_a_run(processes, small):
    processes.coordinator(*small, "--population", 32, "--episodes", 4)
    processes.worker("--task", tasks.SLOW_TOY)
    alone, watched = [], []
    with dashboard(processes) as started, Client((processes.endpoint,)) as client:
        port = int(started.address.strip("/").rpartition(":")[2])
        while client.status("test").generations < 1:
            time.sleep(0.1)
        for _ in range(BLOCKS):
            alone.append(steps_in_a_block(client))
            with open_pages(port) as frames:
                watched.append(steps_in_a_block(client))
            assert min(map(sum, frames)) >= SECONDS / 2, "every page was served"
    share = median(watched) / median(alone)
    assert share > 0.99, (alone, watched)
