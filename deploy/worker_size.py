"""Install a worker into an empty environment and print the size of its parts as a table for docs/."""

import subprocess
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHOWN = 14


def main() -> None:
    """Print the table as Markdown."""
    with tempfile.TemporaryDirectory() as folder:
        environment = Path(folder) / "environment"
        venv.create(environment, with_pip=True)
        pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet", "--no-compile"]
        subprocess.run([*pip, "--constraint", str(ROOT / "constraints.txt"), f"{ROOT}[worker]"], check=True)
        (packages,) = environment.glob("lib/python*/site-packages")
        sizes = sorted(((size(path), path.name) for path in packages.iterdir()), reverse=True)
        total = size(environment)
        print(f"| what | MB |\n|---|---|\n| all | {total / 1e6:.0f} |")
        for amount, name in sizes[:SHOWN]:
            print(f"| {name} | {amount / 1e6:.1f} |")
        print(f"| the rest | {(total - sum(amount for amount, _ in sizes[:SHOWN])) / 1e6:.1f} |")


def size(path: Path) -> int:
    """The size of a file or folder in bytes."""
    if path.is_symlink():
        return 0
    return path.stat().st_size if path.is_file() else sum(size(each) for each in path.iterdir())


if __name__ == "__main__":
    main()
