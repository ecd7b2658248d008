import os

import pytest

from dreamfleet.common.artifacts.bundle_store import default_cache
from dreamfleet.common.security import host_key
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


def test_a_host_that_shares_the_folder_is_another_host(path, tmp_path, monkeypatch):
    key = make_host_key()
    for boot_id in (tmp_path / "boot_id", tmp_path / "none"):
        (tmp_path / "boot_id").write_text("of another machine\n")
        monkeypatch.setattr(host_key, "BOOT_ID", boot_id)
        assert not is_token_of(key, "w/1", host_token("w/1"))
        assert is_token_of(make_host_key(), "w/1", host_token("w/1"))


def test_a_key_of_another_user_or_that_others_may_read_proves_nothing(path):
    path.write_bytes(b"k" * BYTES)
    for mode in (0o644, 0o640, 0o604):
        path.chmod(mode)
        assert (make_host_key(), host_token("w/1")) == (b"", "")
    path.chmod(0o600)
    assert len(make_host_key()) == BYTES
    if os.geteuid() == 0:  # who alone gives files away
        os.chown(path, 65534, 65534)
        assert make_host_key() == b""
