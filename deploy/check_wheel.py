"""Build the sdist and its wheel, install each alone, and check that only `dreamfleet` is installed and starts.

The wheel is installed by the documents' own line, and each link of an installed page must lead to an installed file.
Whatever lies in the current folder, a `worker.py`, a `common/`, a `coordinator.py`, must not be imported for ours.

check_wheel.py PYTHON...: on each of these (`chroot FOLDER python3` is one, if FOLDER shows this machine's TMPDIR), the
wheel drives, films and evolves CarRacing without Box2D, swig and pygame, to the same bits.
"""

import hashlib
import json
import re
import shlex
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXPECTED = (
    "dreamfleet/__init__.py",
    "dreamfleet/__main__.py",
    "dreamfleet/py.typed",
    "dreamfleet/common/pretrained/tiny.zip",
    "dreamfleet/coordinator/addons/dashboard/page/index.html",
    "dreamfleet/deploy/begin.sh",
    "dreamfleet/deploy/systemd/dreamfleet-coordinator@.service",
    "dreamfleet/docs/index.md",
    "dreamfleet/docs/tutorials/own-environment.md",
    "dreamfleet/coordinator/addons/dashboard/page/main.js",
    "dreamfleet/coordinator/service/service.py",
    "dreamfleet/worker/service/worker.py",
)
BESIDE = ("docs", "deploy")  # the package, in a checkout and an sdist
HOSTILE = ("worker.py", "coordinator.py", "common/__init__.py", "tasks.py")
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)\s#]+)")  # without its anchor
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
NAMES = (
    "import importlib.metadata as m; print(*sorted({p.parts[0] for p in m.files('dreamfleet') if p.suffix == '.py'}))"
)


ABSENT = ("box2d", "box2d-py", "pygame-ce", "swig")
EVOLVED = "import sys; from dreamfleet import Controller; print(Controller.load(sys.argv[1]).sha256)"
EPISODES = ("--controller", "real", "--episodes", "20", "--json")
SHORT = ("--run", "short", "--population", "4", "--episodes", "1", "--generations", "2", "--horizon", "99",
         "--evaluate-every", "0")  # fmt: skip


def main(pythons: list[str]) -> int:
    """Exit code 0 if both are complete, or if all Pythons give the same."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if pythons:
            run(sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT))
            (wheel,) = folder.glob("*-cp311-abi3-*.whl")
            found = {python: drive(shlex.split(python), wheel, folder) for python in pythons}
            return int(len({each[1:] for each in found.values()}) > 1)
        run(sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT))
        (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
        for kind, files, known in (
            ("wheel", files_of(wheel), {"dreamfleet"}),
            ("sdist", [each.partition("/")[2] for each in files_of(sdist)], {"dreamfleet", "setup.py", *BESIDE}),
        ):
            if missing := [name for name in EXPECTED if name not in files and name.partition("/")[2] not in files]:
                return complain(f"the {kind} lacks {', '.join(missing)}")
            if strange := {file.partition("/")[0] for file in files if file.endswith(".py")} - known:
                return complain(f"the {kind} holds modules of {', '.join(sorted(strange))}")
        hostile = folder / "hostile"
        for file in HOSTILE:
            (hostile / file).parent.mkdir(parents=True, exist_ok=True)
            (hostile / file).write_text("raise SystemExit('a module of the current folder was imported')\n")
        for archive in (wheel, sdist):
            if problem := try_out(folder / f"environment-{archive.suffix[1:]}", archive, hostile):
                return complain(f"{archive.name}: {problem}")
        print(f"{wheel.name} and {sdist.name} build, install and start; {wheel.stat().st_size / 1e6:.1f} MB")
    return 0


def try_out(environment: Path, archive: Path, folder: Path) -> str:
    """Install an archive and start verbs beside modules named like ours; return the problem, or an empty text."""
    venv.create(environment, with_pip=True)
    python = str(environment / "bin" / "python")
    is_wheel = archive.suffix == ".whl"
    what = ("--find-links", str(archive.parent), "dreamfleet") if is_wheel else (str(archive),)
    run(python, "-m", "pip", "install", "--quiet", "--constraint", str(ROOT / "constraints.txt"), *what)
    (pages,) = environment.glob("lib/python*/site-packages/dreamfleet")
    if dead := dead_links(pages):
        return f"{len(dead)} links lead nowhere, such as {dead[0]}"
    for command in ((str(environment / "bin" / "dreamfleet"),), (python, "-m", "dreamfleet")):
        run(*command, "--help", cwd=folder)
        run(*command, "doctor", cwd=folder)
        run(*command, "runs", "list", cwd=folder)
    importable = capture(python, "-P", "-c", NAMES, cwd=folder).split()
    return "" if importable == ["dreamfleet"] else f"installs {importable}"


def drive(python: list[str], wheel: Path, folder: Path) -> tuple[str, ...]:
    """Print the version of a Python, and digests of a run's controller, of 20 episodes and of a video."""
    version = capture(*python, "-c", "import sys; print(sys.version.split()[0])", cwd=folder).strip()
    environment, runs = folder / version, folder / version / "runs"
    run(*python, "-m", "venv", str(environment))
    inside = (*python[:-1], str(environment / "bin" / "python"), "-m")
    install = ("pip", "install", "--quiet", "--constraint", str(folder / "constraints.txt"), f"{wheel}[worker,views]")
    (folder / "constraints.txt").write_text((ROOT / "constraints.txt").read_text())
    run(*inside, *install)
    run(*inside, "pip", "uninstall", "--quiet", "--yes", *ABSENT)
    run(*inside, "dreamfleet", "doctor", "--role", "worker", cwd=folder)  # not the package of this folder
    report = json.loads(capture(*inside, "dreamfleet", "evaluate", *EPISODES, cwd=folder))
    filmed = ("--controller", "real", "--out", str(environment / "drive.mp4"))
    run(*inside, "dreamfleet", "record", *filmed, cwd=folder)
    scoring = ("dreamfleet", "worker", "--run", "short", "--slots", "1", "--exit-when-done")
    worker = subprocess.Popen([*inside, *scoring], cwd=folder)
    try:
        run(*inside, "dreamfleet", "coordinator", *SHORT, "--runs-dir", str(runs), cwd=folder)
        worker.wait(60)
    finally:
        worker.kill()
    drives = [(each["seed"], each["score"], each["steps"]) for each in report["drives"]]
    evolved = capture(*inside[:-1], "-c", EVOLVED, str(runs / "short" / "controller.npz"), cwd=folder).strip()
    files = repr(drives).encode(), (environment / "drive.mp4").read_bytes()
    made = version, evolved[:16], *(hashlib.sha256(each).hexdigest()[:16] for each in files)
    print(*made, f"{report['mean']:.3f}", report["judge"], flush=True)
    return made


def dead_links(folder: Path) -> list[str]:
    """The relative links of the Markdown pages below a folder that lead to nothing in it: page and target."""
    found = []
    for page in sorted(folder.rglob("*.md")):
        text = FENCED.sub("", page.read_text())
        for target in LINK.findall(text):
            path = (page.parent / target).resolve()
            if not (path.exists() and path.is_relative_to(folder.resolve())):
                found.append(f"{page.relative_to(folder)}: {target}")
    return found


def files_of(archive: Path) -> list[str]:
    """Names of the files in an archive, without links."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            return wheel.namelist()
    with tarfile.open(archive) as sdist:
        return [member.name for member in sdist if member.isfile()]


def complain(text: str) -> int:
    """Report a problem; exit code 1."""
    print(text, file=sys.stderr)
    return 1


def run(*command: str, cwd: Path | None = None) -> None:
    """Run a command; print its output if it fails."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}:\n{done.stdout}{done.stderr}")


def capture(*command: str, cwd: Path) -> str:
    """The output of a command."""
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
