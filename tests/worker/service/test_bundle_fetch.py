"""Interrupted downloads over a real router: parts on disk stay, and the whole file is verified."""

import resource
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from dreamfleet.common.artifacts.bundle_store import BundleStore
from dreamfleet.common.errors import BundleError
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.messages import MAX_PART
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service import bundle_fetch
from dreamfleet.worker.service.bundle_fetch import WINDOW, fetch_bundle
from tests.support import tasks
from tests.support.hand import DEADLINE, Hand
from tests.support.processes import free_port


@pytest.fixture(scope="module")
def bundle(small_bundle):
    return small_bundle


@pytest.fixture(scope="module")
def hand(bundle):
    made = Hand(free_port(), bundle, tasks.TOY)
    yield made
    made.close()


@pytest.fixture(scope="module")
def session(hand):
    with open_session(Network(connect=(hand.endpoint,))) as opened:
        yield opened


@pytest.fixture(autouse=True)
def fresh(hand):
    hand.damage = lambda offset, data: data
    asked(hand)


@pytest.fixture
def store(tmp_path):
    return BundleStore(tmp_path)


def begun(store, bundle, data):
    with store.lock_download(bundle.sha256) as path:
        path.write_bytes(data)
    return path


def fetch(session, hand, store, stopped=lambda: False):
    return fetch_bundle(session, hand.run, hand.spec.bundle, store, CountingDecoder(), stopped)


def asked(hand):
    return [hand.offsets.get_nowait() for _ in range(hand.offsets.qsize())]


SIZES = [0, 1, 17, MAX_PART - 1, MAX_PART, MAX_PART + 1, 3 * MAX_PART + 11, -1, None]


@pytest.mark.parametrize("cut", SIZES)
def test_an_interrupted_download_continues(session, hand, store, bundle, cut):
    whole = bundle.path.read_bytes()
    cut = len(whole) if cut is None else cut % len(whole)
    partial = begun(store, bundle, whole[:cut])
    fetched = fetch(session, hand, store)
    assert fetched.path.read_bytes() == whole
    assert fetched.sha256 == bundle.sha256
    assert not partial.exists()
    assert min(asked(hand)) == cut, "nothing that was there is asked for again"


@pytest.mark.parametrize("where", [0, MAX_PART, 2 * MAX_PART + 16])
def test_a_damaged_beginning_is_fetched_again(session, hand, store, bundle, where):
    spoilt = bytearray(bundle.path.read_bytes()[: 2 * MAX_PART + 17])
    spoilt[where] ^= 1
    begun(store, bundle, bytes(spoilt))
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()
    offsets = asked(hand)
    assert offsets[0] == len(spoilt)
    assert 0 in offsets


def test_a_partial_file_longer_than_the_bundle_is_discarded(session, hand, store, bundle):
    begun(store, bundle, bundle.path.read_bytes() + b"!")
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()


def test_short_parts_never_make_a_wrong_file(session, hand, store, bundle):
    """Every second answer is cut, as by a coordinator that serves smaller parts."""
    short = iter([True, False] * 100)
    hand.damage = lambda offset, data: data[: len(data) // 2] if next(short) else data
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()


def test_a_stopped_download_keeps_its_parts_and_is_continued(session, hand, store, bundle):
    stop = threading.Event()
    hand.damage = lambda offset, data: stop.set() if offset >= 2 * MAX_PART else data  # no answer from here on
    assert fetch(session, hand, store, stop.is_set) is None
    with store.lock_download(bundle.sha256) as partial:
        kept = partial.stat().st_size
    assert kept in (MAX_PART, 2 * MAX_PART)
    asked(hand)
    hand.damage = lambda offset, data: data
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()
    assert min(asked(hand)) == kept


def test_two_workers_of_a_host_fetch_it_once(session, hand, store, bundle):
    with ThreadPoolExecutor() as threads:
        both = [threads.submit(fetch, session, hand, store) for _ in range(2)]
        assert {each.result(DEADLINE).sha256 for each in both} == {bundle.sha256}
    assert len([offset for offset in asked(hand) if offset == 0]) == 1


def test_a_silent_coordinator_is_an_error_and_the_parts_stay(session, hand, store, bundle, monkeypatch):
    monkeypatch.setattr(bundle_fetch, "MAX_ROUNDS_WITHOUT_PROGRESS", 2)
    monkeypatch.setattr(bundle_fetch, "QUERY_TIMEOUT", 0.1)
    monkeypatch.setattr(bundle_fetch, "PAUSE", 0.0)
    partial = begun(store, bundle, bundle.path.read_bytes()[:100])
    hand.damage = lambda offset, data: None
    with pytest.raises(BundleError):
        fetch(session, hand, store)
    assert partial.read_bytes() == bundle.path.read_bytes()[:100]


def test_a_window_of_parts_is_requested_at_once(session, hand, store, bundle):
    fetch(session, hand, store)
    parts = -(-bundle.path.stat().st_size // MAX_PART)
    assert 1 < parts < WINDOW
    assert sorted(asked(hand)) == [index * MAX_PART for index in range(parts)]


def test_a_bundle_of_absurd_length_writes_nothing(session, hand, store, bundle, monkeypatch):
    monkeypatch.setattr(hand, "total", lambda: 2**62)
    with pytest.raises(BundleError, match=r"4,611,686,018,427 .*268"):
        fetch(session, hand, store)
    with store.lock_download(bundle.sha256) as partial:
        assert not partial.stat().st_size


def test_parts_that_name_another_length_are_ignored(session, hand, store, bundle, monkeypatch):
    monkeypatch.setattr(bundle_fetch, "PAUSE", 0.0)
    size, asked = bundle.path.stat().st_size, iter(range(10**6))
    monkeypatch.setattr(hand, "total", lambda: size + next(asked) % 2)
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()


def test_a_beginning_of_another_bundle_is_discarded(session, hand, store, bundle, random_bundle):
    begun(store, bundle, random_bundle.path.read_bytes()[: MAX_PART + 5])
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()


def test_a_full_disk_is_one_line_and_the_parts_stay(session, hand, store, bundle):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_PART + 100, hard))
    try:
        with pytest.raises(BundleError):
            fetch(session, hand, store)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert fetch(session, hand, store).path.read_bytes() == bundle.path.read_bytes()
    assert MAX_PART + 100 in asked(hand)
