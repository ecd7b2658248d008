"""Files that call themselves regular and are not."""

import errno
import os
from io import BufferedReader

import pytest

from dreamfleet.common.files.regular_files import _Readable


@pytest.mark.parametrize("size", [-1, 10])
def test_a_file_that_has_nothing_to_read_yet_is_an_error(size):
    """As `/proc/kmsg` does, which only root may read."""
    read, write = os.pipe2(os.O_NONBLOCK)
    with BufferedReader(_Readable(read)) as file, pytest.raises(OSError, match=str(errno.EINVAL)):
        file.read(size)
    os.close(write)
