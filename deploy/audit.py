"""Look for known vulnerabilities in the oldest versions that pyproject.toml allows, and in all locks; `make audit`.

Compares them with deploy/advisories.json, a dated copy of what is known of our packages, then asks the package index
with pip-audit where that can be reached. Exits with 0 if there are none, 1 if there are, 2 if it could not look.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
COPY = ROOT / "deploy" / "advisories.json"
LOCKS = ("constraints.txt", "deploy/build.lock", "deploy/coordinator.lock", "deploy/worker.lock")
COMMAND = ("-m", "pip_audit", "--disable-pip", "--no-deps", "--format", "json", "--requirement")


@dataclass(frozen=True)
class Advisory:
    """A vulnerability of versions from `introduced` on and before `fixed`; `accepted` says why it is none of ours."""

    package: str
    id: str
    introduced: str
    fixed: str
    accepted: str = ""

    def concerns(self, package: str, version: str) -> bool:
        """Whether this version of this package has it, whatever was accepted."""
        return self.package == package and Version(self.introduced) <= Version(version) < Version(self.fixed)


def main(copy: Path = COPY, root: Path = ROOT) -> int:
    """Print one line for each vulnerability, and what was looked at."""
    try:
        document = json.loads(copy.read_text())
        advisories = [Advisory(**each) for each in document["advisories"]]
        oldest, locked = floors(root / "pyproject.toml"), {name: pins(root / name) for name in LOCKS}
        found = [
            f"{place}: {name} {version}: {each.id}, mended in {each.fixed}"
            for place, versions in {"pyproject.toml": oldest, **locked}.items()
            for name, version in versions for each in advisories
            if each.concerns(name, version) and not each.accepted
        ]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"not audited: {error}", file=sys.stderr)
        return 2
    accepted = {each.id for each in advisories if each.accepted}
    pinned = [each for versions in locked.values() for each in versions]
    for versions in ([each for each in oldest if each[1] != "0"], pinned):
        found += [line for line in ask_index(versions) if not any(each in line for each in accepted)]
    for line in found:
        print(line)
    print(f"{len(oldest)} oldest and {len(set(pinned))} locked versions, {len(found)} known vulnerabilities; "
          f"the copy of the advisories is of {document['date']}")  # fmt: skip
    return 1 if found else 0


def floors(path: Path) -> list[tuple[str, str]]:
    """Package and oldest allowed version for each requirement of a pyproject.toml; 0 where none is named."""
    project = tomllib.loads(path.read_text())
    texts = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    texts += [each for extra in project["project"]["optional-dependencies"].values() for each in extra]
    return sorted({(name, floor(each)) for each in map(Requirement, texts)
                   if (name := canonicalize_name(each.name)) != "dreamfleet"})  # fmt: skip


def floor(requirement: Requirement) -> str:
    """The oldest version that a requirement allows."""
    found = [each.version.removesuffix(".*") for each in requirement.specifier if each.operator in (">=", "==", "~=")]
    return str(max(map(Version, found), default=Version("0")))


def pins(path: Path) -> list[tuple[str, str]]:
    """Package and version for each `==` of a constraints file or lock."""
    found = []
    for line in path.read_text().splitlines():
        try:
            each = Requirement(line.partition("#")[0].strip().removesuffix("\\"))
        except InvalidRequirement:
            continue  # a comment, a hash
        found += [(canonicalize_name(each.name), one.version) for one in each.specifier if one.operator == "=="]
    return found


def ask_index(versions: list[tuple[str, str]]) -> list[str]:
    """What the package index knows of these, as lines; prints why where it cannot be asked."""
    with tempfile.TemporaryDirectory() as folder:
        wanted = Path(folder, "wanted.txt")
        wanted.write_text("".join(f"{name}=={version}\n" for name, version in dict(versions).items()))
        done = subprocess.run([sys.executable, *COMMAND, wanted], capture_output=True, text=True, check=False)
    try:
        audited = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        print(f"the package index was not asked: {(done.stderr.strip().splitlines() or ['no answer'])[-1]}")
        return []
    if skipped := [each["name"] for each in audited if "skip_reason" in each]:
        print(f"the package index says nothing of {len(skipped)} of {len(audited)} packages, such as {skipped[0]}")
    return [f"{each['name']} {each['version']}: {one['id']}, mended in {', '.join(one['fix_versions']) or 'no version'}"
            for each in audited for one in each.get("vulns", ())]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
