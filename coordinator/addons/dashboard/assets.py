"""The static files of the page: our own, and plotly.js from its package."""

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
DIGEST_LENGTH = 16  # characters of the hash in a URL


@dataclass(frozen=True)
class Asset:
    """A static file."""

    data: bytes
    media_type: str

    @cached_property
    def gzipped(self) -> bytes:
        """The compressed data, computed on first use."""
        return gzip.compress(self.data, 6)


class Assets:
    """The files by URL. URLs hold a hash of the content, so browsers may cache them for ever."""

    def __init__(self) -> None:
        """`ModuleNotFoundError` if plotly is not installed."""
        names = sorted(each.name for each in FOLDER.iterdir() if each.suffix in MEDIA_TYPES)
        ours = {name: Asset((FOLDER / name).read_bytes(), MEDIA_TYPES[Path(name).suffix]) for name in names}
        spec = find_spec("plotly")  # without the slow import of the package
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(name="plotly")
        charts = Asset((Path(spec.origin).parent / "package_data" / CHARTS).read_bytes(), MEDIA_TYPES[".js"])
        # The modules import each other, so one hash covers them all.
        self.digest = _digest(*(each.data for each in ours.values()))
        charts_digest = _digest(charts.data)
        self._files = {(self.digest, name): each for name, each in ours.items()} | {(charts_digest, CHARTS): charts}
        text = (FOLDER / INDEX).read_text(encoding="utf-8")
        self.index = text.replace("$ours", f"files/{self.digest}").replace("$charts", f"files/{charts_digest}/{CHARTS}")

    def find(self, digest: str, name: str) -> Asset | None:
        """The file of a URL; `None` if there is none."""
        return self._files.get((digest, name))


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:DIGEST_LENGTH]
