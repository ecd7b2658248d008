"""Tests keys.py and common/runs/seeds.py."""

import re
import socket

import pytest
import zenoh

from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol import keys
from dreamfleet.common.runs import seeds


def test_a_run_has_its_name_in_its_keys_or_is_refused():
    for name in ("a", "night-run-7", "0", "x" * 63, "A", "My_Run-2"):
        assert keys.check_run_name(name) == name
        assert zenoh.KeyExpr(keys.status(name)).intersects(zenoh.KeyExpr(keys.status("*")))
    for name in ("", "-a", "_a", "a b", "a/b", "*", "a" * 64, "ä", "a.b", "../x", "a\n"):
        with pytest.raises(UsageError):
            keys.check_run_name(name)


def test_a_worker_keeps_its_given_name_or_is_refused():
    for name in ("ok", "hostB", "Rack_3.slot-1", "0", "x" * 63):
        identity = keys.new_worker_identity(name)
        assert keys.is_worker_identity(identity)
        assert identity != keys.new_worker_identity(name)
        assert identity.split("/")[0] == name
        assert keys.worker_from_key(keys.result("run", identity)) == identity
        assert zenoh.KeyExpr(keys.job("run", identity)).intersects(zenoh.KeyExpr(keys.all_workers("job", "run")))
    for name in ("", "Big Host!", "***", "-a", ".a", "a/b", "@a", "x" * 64, "häuschen", "a\n"):
        assert not keys.is_worker_identity(f"{name}/0a0b0c0d")
        with pytest.raises(UsageError):
            keys.new_worker_identity(name)


@pytest.mark.parametrize("host", ["Big Host!", "***", "", "ok", "x" * 200, "häuschen"])
def test_every_host_name_gives_a_valid_worker_name(monkeypatch, host):
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    identity = keys.new_worker_identity()
    assert re.fullmatch(r"[a-z0-9][a-z0-9.-]{0,62}/[0-9a-f]{8}", identity)
    assert keys.is_worker_identity(identity)


def test_training_seeds_are_unique_in_their_range_and_disjoint_from_validation_and_test_seeds():
    made = [seeds.training_seed(run, g, e) for run in range(4) for g in range(10) for e in range(10)]
    assert len(set(made)) == len(made)
    assert all(seeds.TRAINING_FIRST <= seed <= seeds.TRAINING_LAST for seed in made)
    assert made[0] == seeds.training_seed(0, 0, 0)
    assert seeds.validation_seeds(3) == (20000, 20001, 20002)
    assert not set(seeds.validation_seeds(100)) & set(seeds.TEST)
    small = [0, 10_000, seeds.TRAINING_FIRST, 2**31 - 1]
    assert [seeds.fold_seed(seed) for seed in small] == small
    assert seeds.fold_seed(2**31) == 2**31 % (2**31 - seeds.TRAINING_FIRST) + seeds.TRAINING_FIRST
    many = {seeds.fold_seed(seeds.training_seed(1, generation, 0)) for generation in range(1000)}
    assert len(many) > 990
    assert all(seeds.TRAINING_FIRST <= each < 2**31 for each in many)
