"""Fetch the frozen world model by its hash: in parts, resumable, verified.

Anybody on the network can answer. So all parts of a download come from one source, and a source whose bytes had another
hash is used again only if nobody else answers. Pages: threats.md, troubleshooting.md.
"""

import logging
import os
import random
from collections.abc import Callable, Collection
from pathlib import Path
from time import sleep

import zenoh

from dreamfleet.common.artifacts.bundle import MAX_BUNDLE, Bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import BundleError, DownloadError
from dreamfleet.common.files.regular_files import open_append
from dreamfleet.common.host.logs import log_event
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.common.transport.query import query_every_responder

log = logging.getLogger(__name__)
WINDOW = 8  # queries in flight: enough to fill a link with a long delay
MAX_ATTEMPTS = 3  # damaged downloads before giving up
MAX_ROUNDS_WITHOUT_PROGRESS = 20  # rounds without progress before giving up
QUERY_TIMEOUT = 3.0
PAUSE = 0.5  # seconds after a round without progress


def fetch_bundle(
    session: zenoh.Session, run: str, sha256: str, store: BundleStore, inbox: CountingDecoder,
    stopped: Callable[[], bool] = lambda: False,
) -> Bundle | None:  # fmt: skip
    """The bundle, from the cache or from the coordinator; `None` if `stopped`, and the parts so far stay in the cache.

    `DownloadError` if nobody answers, or if it arrived damaged `MAX_ATTEMPTS` times.
    """
    bundle = store.find(sha256)
    if bundle is not None:
        return bundle
    corrupt_sources: set[str] = set()  # their bytes had another hash
    with store.lock_download(sha256) as path:
        for attempt in range(1, MAX_ATTEMPTS + 1):
            if (bundle := store.find(sha256)) is not None:  # another worker of this host was faster
                return bundle
            with store.reporting_write_errors():  # the partial file stays: the next worker continues from there
                from_start = not path.exists() or path.stat().st_size == 0
                sources = _download(session, keys.bundle(run, sha256), sha256, path, inbox, stopped, corrupt_sources)
            if stopped():
                return None
            try:
                bundle = store.finish_download(sha256)
            except BundleError as error:
                log.warning("attempt %d of %d: %s", attempt, MAX_ATTEMPTS, error)
                if from_start and len(sources) == 1:  # otherwise any of several sources may have sent the wrong bytes
                    corrupt_sources |= sources
                continue
            text = f"fetched bundle {sha256[:12]}, {bundle.path.stat().st_size / 1e6:.1f} MB"
            log_event(log, "fetched", text, bundle=sha256)
            return bundle
    raise DownloadError(
        f"the bundle {sha256[:12]}... arrived damaged {MAX_ATTEMPTS} times: check the coordinator's copy"
    )


def fetch_bundle_of(controller: Controller, session: zenoh.Session, run: str) -> Bundle | None:
    """The world model of a controller of `run`: cached, shipped, or fetched; `None` if it needs none."""
    if not controller.bundle:
        return None
    return fetch_bundle_now(session, run, controller.bundle).for_controller(controller)


def fetch_bundle_now(session: zenoh.Session, run: str, sha256: str) -> Bundle:
    """The bundle, from this host's cache or from the coordinator of `run`; errors as in `fetch_bundle`."""
    bundle = fetch_bundle(session, run, sha256, BundleStore(default_cache()), CountingDecoder())
    assert bundle is not None  # it cannot be stopped
    return bundle


def _download(
    session: zenoh.Session, key: str, sha256: str, path: Path, inbox: CountingDecoder, stopped: Callable[[], bool],
    corrupt_sources: Collection[str],
) -> set[str]:  # fmt: skip
    """Append to `path` until it is as long as the bundle, or until `stopped`; return the sources of the parts.

    The first part names the length; a part that names another length is ignored. Another source is chosen only when the
    current one is silent.
    """
    total, silences, source = None, 0, ""
    sources: set[str] = set()
    with open_append(path) as file:
        length = file.seek(0, os.SEEK_END)
        while (total is None or length < total) and not stopped():
            before = length
            offsets = [before + index * MAX_PART for index in range(WINDOW if total else 1)]
            wanted = [each for each in offsets if total is None or each < total]
            parts = _query_parts(session, key, sha256, wanted, inbox, stopped, source)
            source = source or _choose_source(parts, corrupt_sources)
            for part in sorted(parts.get(source, []), key=lambda part: part.offset):
                total = _checked_length(part) if total is None else total
                if part.total == total and part.offset == length and length + len(part.data) <= total:
                    length += file.write(part.data)
                    sources.add(source)
            if total is not None and length > total:
                length = file.seek(0)
                file.truncate()  # it was the beginning of another file
            elif length > before or length == total:
                silences = 0
            else:
                silences, total, source = silences + 1, None, ""  # its length may have been wrong
                sleep(PAUSE)
            if silences >= MAX_ROUNDS_WITHOUT_PROGRESS:
                raise DownloadError("the coordinator no longer sends its bundle: try again later")
    return sources


def _choose_source(parts: Collection[str], corrupt_sources: Collection[str]) -> str:
    """One of the sources, at random, so that no liar is always chosen; a corrupt one only if there is no other."""
    known = sorted(set(parts) - set(corrupt_sources)) or sorted(parts)
    return random.choice(known) if known else ""  # noqa: S311 - no secret


def _checked_length(part: BundlePart) -> int:
    """The bundle's length in bytes; `DownloadError` if it is longer than a bundle may be."""
    if part.total > MAX_BUNDLE:
        raise DownloadError(
            f"the coordinator's bundle is said to be {part.total / 1e6:,.0f} MB long, and at most "
            f"{MAX_BUNDLE / 1e6:.0f} MB are fetched: check its copy"
        )
    return part.total


def _query_parts(
    session: zenoh.Session,
    key: str,
    sha256: str,
    offsets: list[int],
    inbox: CountingDecoder,
    stopped: Callable[[], bool],
    source: str,
) -> dict[str, list[BundlePart]]:
    """Parts of this bundle by source. Returns as soon as `source` has sent all of `offsets`."""
    selectors = [f"{key}?offset={offset};length={MAX_PART}" for offset in offsets]
    parts: dict[str, list[BundlePart]] = {}
    for sender, payload in query_every_responder(session, selectors, QUERY_TIMEOUT, stopped=stopped):
        part = inbox.decode(BundlePart, payload)
        if part is not None and part.sha256.hex() == sha256:
            parts.setdefault(sender, []).append(part)
        if len(parts.get(source, [])) == len(offsets):
            break
    return parts
