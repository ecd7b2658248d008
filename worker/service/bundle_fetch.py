"""Fetching the frozen world model by its hash: in parts, resumable, verified.

Whoever reaches the port can answer too. So all of one download is of one answerer, and one whose bytes were not those
of the hash is asked again only where nobody else answers.
"""

from __future__ import annotations

import logging
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
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.common.transport.query import query_every_responder

log = logging.getLogger(__name__)
WINDOW = 8  # queries in flight: enough to fill a link with a long way
MAX_ATTEMPTS = 3  # damaged downloads before giving up
MAX_ROUNDS_WITHOUT_PROGRESS = 20  # rounds without progress before giving up
QUERY_TIMEOUT = 3.0
PAUSE = 0.5  # seconds after a round without progress


def fetch_bundle(
    session: zenoh.Session, run: str, sha256: str, store: BundleStore, inbox: CountingDecoder,
    stopped: Callable[[], bool] = lambda: False,
) -> Bundle | None:  # fmt: skip
    """The bundle from the cache, or fetched from the coordinator; `None` if `stopped`, what has come stays.

    `DownloadError` if it does not come, or comes as something else again and again.
    """
    bundle = store.find(sha256)
    if bundle is not None:
        return bundle
    corrupt_sources: set[str] = set()  # who gave bytes that were not of the hash
    with store.lock_download(sha256) as path:
        for attempt in range(1, MAX_ATTEMPTS + 1):
            if (bundle := store.find(sha256)) is not None:  # another worker of this host was faster
                return bundle
            with store.reporting_write_errors():  # the partial file stays: the next worker continues from there
                anew = not path.exists() or path.stat().st_size == 0
                sources = _download(session, keys.bundle(run, sha256), sha256, path, inbox, stopped, corrupt_sources)
            if stopped():
                return None
            try:
                bundle = store.finish_download(sha256)
            except BundleError as error:
                log.warning("attempt %d of %d: %s", attempt, MAX_ATTEMPTS, error)
                if anew and len(sources) == 1:  # else nobody knows whose bytes they were
                    corrupt_sources |= sources
                continue
            log.info("fetched bundle %s, %.1f MB", sha256[:12], bundle.path.stat().st_size / 1e6)
            return bundle
    raise DownloadError(
        f"the bundle {sha256[:12]}... arrived damaged {MAX_ATTEMPTS} times: check the coordinator's copy"
    )


def fetch_bundle_of(controller: Controller, session: zenoh.Session, run: str) -> Bundle | None:
    """The world model of a controller that `run` reports: cached, shipped, or fetched; `None` if it needs none."""
    if not controller.bundle:
        return None
    bundle = fetch_bundle(session, run, controller.bundle, BundleStore(default_cache()), CountingDecoder())
    assert bundle is not None  # nobody stops it
    return bundle.for_controller(controller)


def _download(
    session: zenoh.Session, key: str, sha256: str, path: Path, inbox: CountingDecoder, stopped: Callable[[], bool],
    corrupt_sources: Collection[str],
) -> set[str]:  # fmt: skip
    """Append to `path` until it is as long as the bundle, or `stopped`; whose parts they were.

    How long that is, the first part says; one that says otherwise is of something else. Another answerer is looked for
    only once the chosen one is silent.
    """
    total, silences, source = None, 0, ""
    sources: set[str] = set()
    with open_append(path) as file:
        while (total is None or file.tell() < total) and not stopped():
            before = file.tell()
            offsets = [before + index * MAX_PART for index in range(WINDOW if total else 1)]
            wanted = [each for each in offsets if total is None or each < total]
            parts = _query_parts(session, key, sha256, wanted, inbox, stopped, source)
            source = source or _choose_source(parts, corrupt_sources)
            for part in sorted(parts.get(source, []), key=lambda part: part.offset):
                total = _checked_length(part) if total is None else total
                if part.total == total and part.offset == file.tell() and part.offset + len(part.data) <= total:
                    file.write(part.data)
                    sources.add(source)
            if total is not None and file.tell() > total:
                file.seek(0)
                file.truncate()  # the beginning of something else
            elif file.tell() > before or file.tell() == total:
                silences = 0
            else:
                silences, total, source = silences + 1, None, ""  # which was perhaps of something else
                sleep(PAUSE)
            if silences >= MAX_ROUNDS_WITHOUT_PROGRESS:
                raise DownloadError("the coordinator no longer answers for its bundle: ask for it later")
    return sources


def _choose_source(parts: Collection[str], corrupt_sources: Collection[str]) -> str:
    """One of those who answer, at random: nobody is sure to be first."""
    known = sorted(set(parts) - set(corrupt_sources)) or sorted(parts)
    return random.choice(known) if known else ""  # noqa: S311 - no secret


def _checked_length(part: BundlePart) -> int:
    """How long the bundle is; `DownloadError` before more is written than a bundle may be."""
    if part.total > MAX_BUNDLE:
        raise DownloadError(
            f"the coordinator says that its bundle is {part.total / 1e6:,.0f} MB long, {MAX_BUNDLE / 1e6:.0f} at most "
            "are fetched: check its copy"
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
    """Parts of this bundle by who gave them; without waiting for others once `source` has given all."""
    selectors = [f"{key}?offset={offset};length={MAX_PART}" for offset in offsets]
    parts: dict[str, list[BundlePart]] = {}
    for who, payload in query_every_responder(session, selectors, QUERY_TIMEOUT, stopped=stopped):
        part = inbox.decode(BundlePart, payload)
        if part is not None and part.sha256.hex() == sha256:
            parts.setdefault(who, []).append(part)
        if len(parts.get(source, [])) == len(offsets):
            break
    return parts
