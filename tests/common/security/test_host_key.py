import os

import pytest

from dreamfleet.common.artifacts.bundle_store import default_cache
from dreamfleet.common.security.host_key import BYTES, host_token, is_token_of, make_host_key


@pytest.fixture
def path():
    default_cache().mkdir(parents=True, exist_ok=True)
    return default_cache() / "host.key"


def test_a_worker_of_the_same_user_and_folder_proves_it(path):
    key = make_host_key()
    assert is_token_of(key, "w/1", host_token("w/1"))
    assert not is_token_of(key, "w/2", host_token("w/1"))
    assert make_host_key() == key


def test_a_key_of_another_user_or_that_others_may_read_proves_nothing(path):
    path.write_bytes(b"k" * BYTES)
    for mode in (0o644, 0o640, 0o604):
        path.chmod(mode)
        assert (make_host_key(), host_token("w/1")) == (b"", "")
    path.chmod(0o600)
    assert make_host_key() == b"k" * BYTES
    if os.geteuid() == 0:  # who alone gives files away
        os.chown(path, 65534, 65534)
        assert make_host_key() == b""
