"""The image's own steps, carried out in a fresh Debian instead of the base image, and what comes of them at work.

No container engine is needed, but root and debootstrap are. Packages are fetched by their hashes beforehand, so that
the steps run without any index.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.support.processes import free_port

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "deploy" / "Containerfile"
LOCKS = [ROOT / "deploy" / f"{name}.lock" for name in ("build", "coordinator", "worker")]

pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root"),
    pytest.mark.needs_programs("debootstrap"),
]


@dataclass
class Stage:
    """A stage: its root, and the settings of its processes."""

    root: Path
    variables: dict[str, str] = field(default_factory=dict)
    folder: str = "/"
    user: str = "0:0"
    entry: list[str] = field(default_factory=list)

    def derived(self, root):
        subprocess.run(["cp", "-a", self.root, root], check=True)
        return Stage(root, dict(self.variables), self.folder, self.user)

    def run(self, script, wheels):
        given = self.root / "given"
        given.mkdir(exist_ok=True)
        words = self.command("sh", "-c", script, mounts=[(wheels, "/given")], PIP_NO_INDEX="1",
                             PIP_FIND_LINKS="/given", DEBIAN_FRONTEND="noninteractive")  # fmt: skip
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        given.rmdir()
        assert done.returncode == 0, f"{script}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"

    def command(self, *words, read_only=False, mounts=(), **variables):
        """A command that runs words inside, isolated from this process's environment."""
        root = shlex.quote(str(self.root))
        script = [f"mount --rbind {root} {root}", *([f"mount -o remount,bind,ro {root}"] if read_only else [])]
        script += [f"mount --rbind /dev {root}/dev", f"mount -t proc proc {root}/proc"]
        script += [f"mount -t tmpfs -o mode=1777 tmpfs {root}/tmp"] if read_only else []
        script += [f"mount --bind {shlex.quote(str(ours))} {root}{theirs}" for ours, theirs in mounts]
        given = {"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "HOME": "/tmp"} | self.variables | variables
        inside = ["env", "-i", "-C", self.folder, *(f"{name}={text}" for name, text in given.items()), *map(str, words)]
        user, group = self.user.split(":")
        leave = f"setpriv --reuid {user} --regid {group} --clear-groups --no-new-privs --bounding-set=-all".split()
        script += [shlex.join(["exec", "chroot", str(self.root), *(leave if self.user != "0:0" else []), *inside])]
        return ["unshare", "--mount", "--pid", "--fork", "sh", "-ec", "\n".join(script)]


def copy(source, names, there, ignore):
    """As image builders do: of a folder its content."""
    for path in (source / name.lstrip("/") for name in names):
        if path.is_dir():
            shutil.copytree(path, there, symlinks=True, dirs_exist_ok=True, ignore=ignore)
        else:
            into = there / path.name if there.is_dir() else there
            into.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, into)


def built(text, base, folder, wheels):
    """The stages of a Containerfile, as far as this project's file needs."""
    stages = {}
    kept = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for line in filter(str.strip, re.split(r"(?<!\\)\n", kept)):
        word, rest = re.match(r"([A-Z]+)\s+(.*)", line, re.DOTALL).groups()
        match word, rest.split():
            case "ARG", [given] if given.startswith("PYTHON="):
                assert given.startswith("PYTHON=python:3.11-")  # the version in Debian
            case "FROM", [origin, "AS", name]:
                before = Stage(base) if origin == "${PYTHON}" else stages[origin]
                now = stages[name] = before.derived(folder / f"stage-{name}")
            case "ARG" | "ENV", _:
                now.variables |= dict(each.split("=", 1) for each in rest.replace("\\\n", " ").split())
            case "RUN", _:
                now.run(rest, wheels)
            case "COPY", [*flags, target]:
                origin = flags.pop(0).removeprefix("--from=") if flags[0].startswith("--from=") else ""
                there = now.root / (Path(now.folder) / target).as_posix().lstrip("/")
                if target.endswith("/"):
                    there.mkdir(parents=True, exist_ok=True)
                unwanted = None if origin else shutil.ignore_patterns("__pycache__", "*.so")
                copy(stages[origin].root if origin else ROOT, flags, there, unwanted)
            case "WORKDIR", _:
                now.folder = rest
                (now.root / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
            case "USER", _:
                now.user = rest
            case "ENTRYPOINT", _:
                now.entry = json.loads(rest)
            case "VOLUME", _:
                assert (now.root / rest.lstrip("/")).is_dir()
            case _:
                assert word in ("EXPOSE", "CMD"), line
    return stages


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("image")
    base, wheels = folder / "debian", folder / "wheels"
    fetch = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--dest", wheels]
    for lock in LOCKS:
        subprocess.run([*fetch, "--requirement", lock], check=True)
    packages = "--include=python3,python3-venv,python3-dev"
    subprocess.run(["debootstrap", "--variant=minbase", packages, "bookworm", base], check=True, capture_output=True)
    (base / "usr/local/bin/python").symlink_to("/usr/bin/python3")
    yield built(RECIPE.read_text(), base, folder, wheels)
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("stage", "absent"), [("worker", "torch pip onnx"), ("coordinator", "torch pip onnxruntime gymnasium pygame Box2D")]
)
def test_an_image_holds_no_more_than_it_needs(images, stage, absent):
    (folder,) = (images[stage].root / "opt/dreamfleet").glob("lib/python*/site-packages")
    assert not {path.name for path in folder.iterdir()} & {*absent.split()}
    assert images[stage].user == "10001:10001"
    assert not list(images[stage].root.glob("usr/bin/*gcc*"))
    said = subprocess.run(images[stage].command("sh", "-c", "id -u; touch /opt/x", read_only=True),
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert said.stdout == "10001\n"
    assert "Read-only file system" in said.stderr


def test_two_images_make_a_run_on_a_read_only_root(images, tmp_path):
    coordinator, worker = images["coordinator"], images["worker"]
    runs, endpoint = tmp_path / "volume", f"tcp/127.0.0.1:{free_port()}"
    runs.mkdir(mode=0o700)
    os.chown(runs, 10001, 10001)
    fit = subprocess.run(worker.command("/opt/dreamfleet/bin/dreamfleet", "doctor", "--role", "worker", read_only=True),
                         capture_output=True, text=True, check=False)  # fmt: skip
    assert fit.returncode == 0, fit.stdout + fit.stderr
    settings = ("night", "--population", 4, "--episodes", 1, "--horizon", 20, "--evaluate-every", 0, "--generations", 2,
                "--listen", endpoint)  # fmt: skip
    served = coordinator.command(*coordinator.entry, *settings, read_only=True, mounts=[(runs, "/runs")])
    scoring = worker.command(*worker.entry, "--run", "night", "--slots", 1, read_only=True, DREAMFLEET_CONNECT=endpoint)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    with subprocess.Popen(served, **streams) as one, subprocess.Popen(scoring, **streams) as other:
        try:
            said, _ = one.communicate(timeout=300)
            assert one.returncode == 0, said
        finally:
            for process in (one, other):
                with suppress(ProcessLookupError):  # processes inside are another user's and outlive their parent
                    os.killpg(process.pid, signal.SIGKILL)
            other.communicate()
    assert (runs / "night" / "controller.npz").is_file()
