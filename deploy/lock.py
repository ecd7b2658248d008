"""Write deploy/*.lock: exact versions of the packages in an image, with the hashes of all their files.

python lock.py, in an environment with pip-tools; `make lock`. Versions are those that the tests run with.
"""

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
HEAD = "# Written by `make lock` on Python {}.{}, for 3.11 to 3.14, wherever wheels are: use --require-hashes.\n"
QUIET = ("--no-header", "--no-annotate", "--no-emit-options", "--no-emit-index-url", "--no-emit-find-links")


def main() -> None:
    """Write all locks."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    own, extras = project["project"]["dependencies"], project["project"]["optional-dependencies"]
    for name, wanted in (
        ("coordinator", own),
        ("worker", [*own, *extras["worker"]]),
        ("build", project["build-system"]["requires"]),
    ):
        (HERE / f"{name}.lock").write_text(HEAD.format(*sys.version_info) + resolve(wanted))
        print(f"deploy/{name}.lock")


def resolve(wanted: list[str]) -> str:
    """The text of a lock."""
    with tempfile.TemporaryDirectory() as name:
        given, found = Path(name) / "wanted.in", Path(name) / "found.txt"
        given.write_text("\n".join(wanted))
        command = (
            sys.executable,
            "-m",
            "piptools",
            "compile",
            "--quiet",
            "--generate-hashes",
            "--strip-extras",
            *QUIET,
        )
        more = ("--allow-unsafe", "--constraint", ROOT / "constraints.txt", "--output-file", found, given)
        subprocess.run([*command, *more], check=True)
        lines = found.read_text().splitlines(keepends=True)
        return "".join(line for line in lines if line.strip() and not line.startswith("#"))


if __name__ == "__main__":
    main()
