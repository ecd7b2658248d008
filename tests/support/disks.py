"""Small disks that a test can fill, if this process may mount them, and files that may not grow."""

import os
import resource
import subprocess
from contextlib import contextmanager


class SmallDisk:
    """A disk of so many megabytes at `path`."""

    def __init__(self, path, megabytes):
        self.path = path
        self._ballast = path / ".ballast"
        path.mkdir(parents=True, exist_ok=True)
        _run("mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", path)

    @property
    def full(self):
        return self._ballast.exists()

    def fill(self):
        with self._ballast.open("wb") as file:
            for step in (1 << 24, 1 << 16, 1 << 12):
                try:
                    while True:
                        os.posix_fallocate(file.fileno(), file.seek(0, os.SEEK_END), step)
                except OSError:
                    continue

    def free(self):
        self._ballast.unlink(missing_ok=True)


@contextmanager
def _mounted(mount, path):
    """What `mount` gives for this path, which is unmounted at the end; `None` if this process may not mount."""
    try:
        made = mount(path)
    except (OSError, subprocess.CalledProcessError):
        yield None
        return
    try:
        yield made
    finally:
        _run("umount", "--lazy", path)


def small_disk(path, megabytes):
    """A disk, or `None` if this process may not mount one."""
    return _mounted(lambda path: SmallDisk(path, megabytes), path)


def read_only_view(folder, path):
    """The same files at `path`, where nobody can write, while `folder` stays writable; `None` without the right."""

    def mount(path):
        path.mkdir()
        _run("mount", "--bind", folder, path)
        _run("mount", "-o", "remount,bind,ro", path)
        return path

    return _mounted(mount, path)


@contextmanager
def file_size_limit():
    """A function that limits the bytes of each file of this process until the end, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def _run(*words):
    subprocess.run(list(map(str, words)), check=True, capture_output=True)
