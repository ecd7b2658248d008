"""Interrupted, damaged and foreign downloads over a real router: parts on disk stay, and the whole file is verified."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from dreamfleet.common.artifacts.bundle_store import BundleStore
from dreamfleet.common.errors import BundleError, DownloadError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service import bundle_fetch
from dreamfleet.worker.service.bundle_fetch import MAX_ATTEMPTS, fetch_bundle
from tests.support import tasks
from tests.support.disks import file_size_limit
from tests.support.hand import DEADLINE, Hand, unknown_sender
from tests.support.processes import free_port


class Download:
    """A worker's download of the small bundle, whose bytes are `content`, into a new store."""

    def __init__(self, hand, session, bundle, store):
        self.hand, self.session, self.sha256, self.store = hand, session, bundle.sha256, store
        self.content = bundle.path.read_bytes()

    def begin(self, data):
        """Write what an earlier download left; its path."""
        with self.store.lock_download(self.sha256) as path:
            path.write_bytes(data)
        return path

    def fetch(self, stopped=lambda: False):
        """The bytes of the bundle."""
        bundle = fetch_bundle(self.session, self.hand.run, self.sha256, self.store, CountingDecoder(), stopped)
        return None if bundle is None else bundle.path.read_bytes()

    def asked(self):
        """The offsets that were asked for since the last call."""
        return [self.hand.offsets.get_nowait() for _ in range(self.hand.offsets.qsize())]


@pytest.fixture(scope="module")
def link(small_bundle):
    hand = Hand(free_port(), small_bundle, tasks.TOY)
    with open_session(Network(connect=(hand.endpoint,))) as session:
        yield hand, session
    hand.close()


@pytest.fixture
def download(link, small_bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_fetch, "PAUSE", 0.0)
    made = Download(*link, small_bundle, BundleStore(tmp_path))
    made.hand.damage = lambda offset, data: data
    made.asked()
    return made


@pytest.mark.parametrize("cut", [0, 1, MAX_PART - 1, MAX_PART, MAX_PART + 1, 3 * MAX_PART + 11, -1, None])
def test_an_interrupted_download_continues(download, cut):
    partial = download.begin(download.content[:cut])
    length = partial.stat().st_size
    assert download.fetch() == download.content
    assert not partial.exists()
    asked = list(range(length, max(len(download.content), length + 1), MAX_PART))
    assert sorted(download.asked()) == asked, "each part once, and nothing that was there"


@pytest.mark.parametrize("cut", [0, 2 * MAX_PART + 16, None], ids=["begins wrong", "ends wrong", "is too long"])
def test_what_is_no_beginning_of_the_bundle_is_fetched_again(download, cut):
    right = download.content[: 2 * MAX_PART + 17]
    wrong = download.content + b"!" if cut is None else right[:cut] + bytes([right[cut] ^ 1]) + right[cut + 1 :]
    download.begin(wrong)
    assert download.fetch() == download.content
    offsets = download.asked()
    assert offsets[0] == len(wrong)
    assert 0 in offsets


def test_a_damaged_part_costs_one_more_download(download):
    spoilt = iter([bytes(MAX_PART)[:-1] + b"!"])
    download.hand.damage = lambda offset, data: next(spoilt, data) if offset == 2 * MAX_PART else data
    assert download.fetch() == download.content
    assert download.asked().count(2 * MAX_PART) == 2


def test_a_bundle_that_is_always_damaged_is_an_error(download):
    download.hand.damage = lambda offset, data: data[::-1]
    with pytest.raises(DownloadError):
        download.fetch()
    assert download.asked().count(0) == MAX_ATTEMPTS


def test_wrong_parts_of_an_unknown_sender_do_not_prevent_the_download(download):
    total = len(download.content)

    def lie(query):
        offset = int(query.parameters.get("offset"))
        data = bytes(min(MAX_PART, total - offset))
        head = {"run_uid": download.hand.run_uid, "incarnation": 1, "sha256": bytes.fromhex(download.sha256)}
        return encode(BundlePart(**head, offset=offset, total=total, data=data))

    with unknown_sender(download.hand, keys.bundle(download.hand.run, download.sha256), lie):
        assert download.fetch() == download.content


def test_short_parts_never_make_a_wrong_file(download):
    """Every second answer is cut, as by a coordinator that serves smaller parts."""
    short = iter([True, False] * 100)
    download.hand.damage = lambda offset, data: data[: len(data) // 2] if next(short) else data
    assert download.fetch() == download.content


def test_a_stopped_download_keeps_its_parts_and_is_continued(download):
    stop = threading.Event()
    download.hand.damage = lambda offset, data: stop.set() if offset >= 2 * MAX_PART else data  # no answer from here on
    assert download.fetch(stop.is_set) is None
    with download.store.lock_download(download.sha256) as partial:
        kept = partial.stat().st_size
    assert kept in (MAX_PART, 2 * MAX_PART)
    download.asked()
    download.hand.damage = lambda offset, data: data
    assert download.fetch() == download.content
    assert min(download.asked()) == kept


def test_two_workers_of_a_host_fetch_it_once(download):
    with ThreadPoolExecutor() as threads:
        both = [threads.submit(download.fetch) for _ in range(2)]
        assert {each.result(DEADLINE) for each in both} == {download.content}
    assert download.asked().count(0) == 1


def test_a_silent_coordinator_is_an_error_and_the_parts_stay(download, monkeypatch):
    monkeypatch.setattr(bundle_fetch, "MAX_ROUNDS_WITHOUT_PROGRESS", 2)
    monkeypatch.setattr(bundle_fetch, "QUERY_TIMEOUT", 0.1)
    partial = download.begin(download.content[:100])
    download.hand.damage = lambda offset, data: None
    with pytest.raises(BundleError):
        download.fetch()
    assert partial.read_bytes() == download.content[:100]


def test_a_bundle_of_absurd_length_writes_nothing(download, monkeypatch):
    partial = download.begin(b"")
    monkeypatch.setattr(download.hand, "total", lambda: 2**62)
    with pytest.raises(BundleError, match=r"4,611,686,018,427 .*268"):
        download.fetch()
    assert partial.read_bytes() == b""


def test_parts_that_name_another_length_are_ignored(download, monkeypatch):
    answers = iter(range(10**6))
    monkeypatch.setattr(download.hand, "total", lambda: len(download.content) + next(answers) % 2)
    assert download.fetch() == download.content


def test_on_a_full_disk_the_parts_stay(download):
    with file_size_limit() as limit:
        limit(MAX_PART + 100)
        with pytest.raises(BundleError):
            download.fetch()
    assert download.fetch() == download.content
    assert MAX_PART + 100 in download.asked()
