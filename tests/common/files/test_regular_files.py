"""Files that call themselves regular and are not."""

import os
from io import BufferedReader

import pytest

from dreamfleet.common.errors import AccessError
from dreamfleet.common.files.regular_files import _Readable, open_regular, read_regular
from dreamfleet.common.security.credentials import read_join_file


@pytest.mark.parametrize("size", [-1, 10])
def test_a_file_that_has_nothing_to_read_yet_is_an_error(size):
    """As `/proc/kmsg` does, which only root may read."""
    read, write = os.pipe2(os.O_NONBLOCK)
    with BufferedReader(_Readable(read)) as file, pytest.raises(OSError, match="it is not a regular file"):
        file.read(size)
    os.close(write)


@pytest.mark.skipif(not os.access("/proc/kmsg", os.R_OK), reason="only root may read it")
def test_the_kernels_log_is_an_error_in_one_line(tmp_path):
    link = tmp_path / "join.toml"
    link.symlink_to("/proc/kmsg")
    try:
        with open_regular(link) as file:
            while file.read1(1 << 16):
                pass
    except OSError:
        pass
    with pytest.raises(OSError, match="regular"):
        read_regular(link, 1 << 16)
    with pytest.raises(AccessError, match="cannot be read as a join file"):
        read_join_file(link)
