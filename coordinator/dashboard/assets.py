"""What a browser loads once: our own page, and the charts' library as its package ships it."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

FOLDER = Path(__file__).parent / "page"
INDEX = "index.html"
CHARTS = "plotly.min.js"
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
DIGEST_LENGTH = 16  # characters of a hash in an address


@dataclass(frozen=True)
class Asset:
    """One file, as it is and packed."""

    data: bytes
    media_type: str

    @cached_property
    def gzipped(self) -> bytes:
        """With gzip; made when it is first asked for."""
        return gzip.compress(self.data, 6)


class Assets:
    """Addresses hold a hash of what lies there, so that a browser may keep it for ever."""

    def __init__(self) -> None:
        """`ModuleNotFoundError` where plotly is not installed."""
        names = sorted(each.name for each in FOLDER.iterdir() if each.suffix in MEDIA_TYPES)
        ours = {name: Asset((FOLDER / name).read_bytes(), MEDIA_TYPES[Path(name).suffix]) for name in names}
        charts = Asset(_plotly_path().read_bytes(), MEDIA_TYPES[".js"])
        # The modules name each other, so one hash is of them all.
        self.digest = _digest(*(each.data for each in ours.values()))
        charts_digest = _digest(charts.data)
        self._files = {(self.digest, name): each for name, each in ours.items()} | {(charts_digest, CHARTS): charts}
        text = (FOLDER / INDEX).read_text(encoding="utf-8")
        self.index = text.replace("$ours", f"files/{self.digest}").replace("$charts", f"files/{charts_digest}/{CHARTS}")

    def find(self, digest: str, name: str) -> Asset | None:
        """The file at an address."""
        return self._files.get((digest, name))


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:DIGEST_LENGTH]


def _plotly_path() -> Path:
    """Found without importing the package, which takes long and is not needed."""
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(name="plotly")
    return Path(spec.origin).parent / "package_data" / CHARTS
