"""What must pass before a change lands, in parts. Prints the time of each, and which tests failed by chance.

A test that failed runs once more, by itself and after the others. If it passes then, it is unstable: a run may have
three of these. A test with the mark `exact` never runs again: once wrong is wrong.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

MAX_UNSTABLE = 3
VENVS = {"test": ".venv", "slow": ".venv", "test-doom": ".venv", "test-newest": ".venv-newest"}  # parts that are tests
# Doom comes after the tests that run without it: what they need must not come with it.
PARTS = ("check", "test", "slow", "test-doom", "test-newest")


@dataclass
class Part:
    """One target of the Makefile: its seconds, and the tests that failed once, twice, or cannot be tried again."""

    name: str
    seconds: float = 0.0
    failed: list[str] = field(default_factory=list)
    unstable: list[str] = field(default_factory=list)

    def run(self, may_be_unstable: int) -> None:
        """Run it, then each of its failed tests once more, if no more failed than `may_be_unstable`."""
        began = time.monotonic()
        cache = Path("build/ci") / self.name
        record = cache / "v/cache/lastfailed"
        record.unlink(missing_ok=True)
        options = f"ARGS=-o cache_dir={cache} --durations=20 --junit-xml={cache}/times.xml"  # the seconds of each test
        arguments = [options] if self.name in VENVS else []
        passed = subprocess.run(["make", self.name, *arguments], check=False).returncode == 0
        if not passed:
            tests = sorted(json.loads(record.read_text())) if record.exists() else []
            self.failed = tests or [f"make {self.name}"]
            if 0 < len(tests) <= may_be_unstable:
                self.unstable = [each for each in tests if self._passes_again(each)]
                self.failed = [each for each in tests if each not in self.unstable]
        self.seconds = time.monotonic() - began

    def _passes_again(self, test: str) -> bool:
        if "::" not in test:  # a module that cannot be imported
            return False
        pytest = f"{VENVS[self.name]}/bin/pytest"  # 5, "no test ran", for one that is `exact`
        return subprocess.run([pytest, "-m", "not exact", "-p", "no:cacheprovider", test], check=False).returncode == 0


def main(names: Sequence[str]) -> int:
    """Run all parts, or those named; the exit code."""
    parts: list[Part] = []
    for name in names or PARTS:
        parts.append(Part(name))
        parts[-1].run(MAX_UNSTABLE - sum(len(each.unstable) for each in parts))
    print("\nminutes:", ", ".join(f"{each.name} {each.seconds / 60:.1f}" for each in parts), end="; ")
    print(f"all {sum(each.seconds for each in parts) / 60:.1f}")
    for part in parts:
        for each in part.failed:
            print(f"failed ({part.name}): {each}")
    unstable = [f"{each} ({part.name})" for part in parts for each in part.unstable]
    print("unstable, passed when run again:", ", ".join(unstable) or "none", flush=True)
    return int(any(part.failed for part in parts))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
