"""With this folder on PYTHONPATH each message of the product is a key: a test that still passes reads no sentence.

`make keyed` runs the tests so. Modules are compiled into a cache of their own.
"""

import ast
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from zlib import crc32

ROOT = Path(__file__).resolve().parents[3]
PARTS = ("common", "coordinator", "worker", "dreamfleet")
MESSAGES = crc32((ROOT / "deploy" / "messages.py").read_bytes())  # what it changes is compiled anew
sys.pycache_prefix = str(ROOT / "build" / "keyed" / f"{MESSAGES:08x}")
sys.dont_write_bytecode = False
plain = SourceFileLoader.source_to_code


def source_to_code(self, data, path, *, _optimize=-1):
    """Code of ours with its messages as keys; that of others as it is."""
    place = Path(path).resolve()
    if not place.is_relative_to(ROOT) or (parts := place.relative_to(ROOT).parts)[0] not in PARTS:
        return plain(self, data, path, _optimize=_optimize)
    sys.path.append(str(ROOT / "deploy"))
    try:
        from messages import keyed
    finally:
        sys.path.remove(str(ROOT / "deploy"))
    return compile(keyed(ast.parse(data), ".".join(parts)), path, "exec", dont_inherit=True, optimize=_optimize)


SourceFileLoader.source_to_code = source_to_code
