"""Copies pages and recipes into the package, and stops the build of a clone without symbolic links.

pyproject.toml says all else. A clone without links would make a hollow wheel.
"""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
if (ROOT / "dreamfleet" / "common").is_file():
    raise SystemExit(
        "dreamfleet/common is a file: git made no symbolic links. Make them (on Windows in WSL), then install again: "
        "git config core.symlinks true && git checkout -- dreamfleet"
    )


class BuildWithPages(build_py):
    """Puts what `package-data` of `dreamfleet` names in the repository, such as `docs/index.md`, into the package."""

    def run(self) -> None:
        """Build, then copy; an editable installation finds the files where they are."""
        super().run()
        if self.editable_mode:
            return
        for pattern in self.package_data["dreamfleet"]:
            for path in ROOT.glob(pattern):
                target = Path(self.build_lib, "dreamfleet", path.relative_to(ROOT))
                self.mkpath(str(target.parent))
                self.copy_file(str(path), str(target))


setup(cmdclass={"build_py": BuildWithPages})
