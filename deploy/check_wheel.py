"""Build the wheel, install it into an empty environment, and see that a coordinator's verbs start there."""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXPECTED = ("common/pretrained/tiny.zip", "coordinator/service.py", "worker/service.py", "common/py.typed")


def main() -> int:
    """Exit code 0 when the wheel is whole."""
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "-m", "build", "--wheel", "--outdir", folder, str(ROOT))
        (wheel,) = Path(folder).glob("*.whl")
        environment = Path(folder) / "environment"
        venv.create(environment, with_pip=True)
        python = str(environment / "bin" / "python")
        run(python, "-m", "pip", "install", "--quiet", "--constraint", str(ROOT / "constraints.txt"), str(wheel))
        files = capture(python, "-m", "pip", "show", "--files", "dreamfleet")
        missing = [name for name in EXPECTED if name not in files]
        if missing:
            print(f"the wheel lacks {', '.join(missing)}", file=sys.stderr)
            return 1
        run(str(environment / "bin" / "dreamfleet"), "--help", cwd=folder)
        run(str(environment / "bin" / "dreamfleet"), "doctor", cwd=folder)
        print(f"{wheel.name} builds, installs and starts; {wheel.stat().st_size / 1e6:.1f} MB")
    return 0


def run(*command: str, cwd: str | None = None) -> None:
    """Run quietly; show what was said if it fails."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}:\n{done.stdout}{done.stderr}")


def capture(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    raise SystemExit(main())
