import os
import re
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output

NOBODY = 65534


def test_an_impossible_path_is_an_error_before_the_work_and_devices_and_pipes_are_not_replaced(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "tiny.json", pipe, link):
        with pytest.raises(UsageError, match="--out"):
            check_output_path(path)
        with pytest.raises(DreamfleetError, match=re.escape(str(path))), open_output(path):
            pass
    assert pipe.is_fifo()
    assert link.is_symlink()


@contextmanager
def without_root():
    """Root may write anywhere, so a test that needs a refusal gives up root's rights for a moment."""
    user = os.getuid()
    os.setresuid(NOBODY if user == 0 else user, NOBODY if user == 0 else user, user)
    try:
        yield
    finally:
        os.setresuid(user, user, user)


def test_a_read_only_folder_is_reported_before_the_work():
    with tempfile.TemporaryDirectory() as name:  # not tmp_path, which another user may not enter
        folder = Path(name)
        folder.chmod(0o777)
        with without_root():
            check_output_path(folder / "tiny.json")
        folder.chmod(0o555)
        with without_root(), pytest.raises(UsageError, match="--out"):
            check_output_path(folder / "tiny.json")


def test_the_folder_is_created_the_file_is_complete_and_a_failed_write_leaves_the_old_one(tmp_path):
    path = tmp_path / "results" / "tiny.json"
    check_output_path(path)
    with open_output(path) as file:
        file.write(b"before")
    with suppress(RuntimeError), open_output(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert list(path.parent.iterdir()) == [path]
    assert path.read_text() == "before"
    with pytest.raises(DreamfleetError, match="n" * 300), open_output(tmp_path / ("n" * 300)):
        pass
