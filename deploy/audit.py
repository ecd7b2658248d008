"""Look up known vulnerabilities of the packages in deploy/worker.lock with pip-audit; `make audit`.

Exits with 0 if there are none, 1 if there are, 2 if that could not be found out.
"""

import json
import subprocess
import sys
from pathlib import Path

LOCK = Path(__file__).parent / "worker.lock"
COMMAND = ("-m", "pip_audit", "--requirement", LOCK, "--disable-pip", "--no-deps", "--format", "json")


def main() -> int:
    """Print one line for each vulnerability."""
    done = subprocess.run([sys.executable, *COMMAND], capture_output=True, text=True, check=False)
    try:
        audited = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        said = done.stderr.strip().splitlines()
        return cannot(said[-1] if said else "it said nothing")
    if skipped := [each["name"] for each in audited if "skip_reason" in each]:
        return cannot(f"nothing is known about {len(skipped)} of {len(audited)} packages, such as {skipped[0]}")
    found = [(each["name"], each["version"], one) for each in audited for one in each["vulns"]]
    for name, version, one in found:
        print(f"{name} {version}: {one['id']}, mended in {', '.join(one['fix_versions']) or 'no version'}")
    print(f"{len(audited)} packages, {len(found)} known vulnerabilities")
    return 1 if found else 0


def cannot(why: str) -> int:
    """Report that the check failed; exit code 2."""
    print(f"not audited: {why}; run it where the advisories of the package index can be reached", file=sys.stderr)
    return 2


if __name__ == "__main__":
    raise SystemExit(main())
