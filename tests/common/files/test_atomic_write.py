"""`--out` is checked before the work, and written atomically."""

import os
from contextlib import suppress

import pytest

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output


def test_the_folder_is_created_and_the_file_is_complete(tmp_path):
    path = tmp_path / "results" / "tiny.json"
    check_output_path(path)
    with open_output(path) as file:
        file.write(b"all of it")
    assert path.read_bytes() == b"all of it"


def test_an_impossible_path_is_an_error_before_the_work(tmp_path):
    with pytest.raises(UsageError, match="is a folder"):
        check_output_path(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot be created"):
        check_output_path(tmp_path / "file" / "tiny.json")


def test_devices_and_pipes_are_not_replaced(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    for path in (pipe, link):
        with pytest.raises(UsageError, match="it is not a regular file: choose another"):
            check_output_path(path)
        with pytest.raises(DreamfleetError, match="cannot write"), open_output(path):
            pass
    assert pipe.is_fifo()
    assert link.is_symlink()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_an_error_before_the_work(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UsageError, match="is not writable"):
        check_output_path(tmp_path / "tiny.json")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text("before")
    with suppress(RuntimeError), open_output(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert [each.name for each in tmp_path.iterdir()] == ["tiny.json"]
    assert path.read_text() == "before"
    with pytest.raises(DreamfleetError, match="cannot write"), open_output(tmp_path / ("n" * 300)):
        pass
