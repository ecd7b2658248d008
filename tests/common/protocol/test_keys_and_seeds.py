"""Tests keys.py and common/runs/seeds.py."""

import re
import socket

import pytest
import zenoh

from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol import keys
from dreamfleet.common.runs import seeds


@pytest.mark.parametrize("name", ["a", "night-run-7", "0", "x" * 63, "A", "My_Run-2"])
def test_good_run_names(name):
    assert keys.check_run_name(name) == name
    assert zenoh.KeyExpr(keys.status(name)).intersects(zenoh.KeyExpr(keys.status("*")))


@pytest.mark.parametrize("name", ["", "-a", "_a", "a b", "a/b", "*", "a" * 64, "ä", "a.b", "../x", "a\n"])
def test_bad_run_names_are_refused(name):
    with pytest.raises(UsageError):
        keys.check_run_name(name)


@pytest.mark.parametrize("name", ["ok", "hostB", "Rack_3.slot-1", "0", "x" * 63])
def test_a_worker_keeps_its_given_name(name):
    identity = keys.new_worker_identity(name)
    assert keys.is_worker_identity(identity)
    assert identity != keys.new_worker_identity(name)
    assert identity.split("/")[0] == name
    assert zenoh.KeyExpr(keys.job("run", identity)).intersects(zenoh.KeyExpr(keys.all_workers("job", "run")))


@pytest.mark.parametrize("name", ["", "Big Host!", "***", "-a", ".a", "a/b", "@a", "x" * 64, "häuschen", "a\n"])
def test_an_invalid_worker_name_is_refused(name):
    assert not keys.is_worker_identity(f"{name}/0a0b0c0d")
    with pytest.raises(UsageError):
        keys.new_worker_identity(name)


@pytest.mark.parametrize("host", ["Big Host!", "***", "", "ok", "x" * 200, "häuschen"])
def test_every_host_name_gives_a_valid_worker_name(monkeypatch, host):
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    assert re.fullmatch(r"[a-z0-9][a-z0-9.-]{0,62}/[0-9a-f]{8}", keys.new_worker_identity())
    assert keys.is_worker_identity(keys.new_worker_identity())


def test_a_workers_key_contains_its_identity():
    assert keys.worker_from_key(keys.result("run", "host/0a0b0c0d")) == "host/0a0b0c0d"


def test_training_seeds_are_unique_and_in_the_training_range():
    made = [seeds.training_seed(run, g, e) for run in range(4) for g in range(10) for e in range(10)]
    assert len(set(made)) == len(made)
    assert all(seeds.TRAINING_FIRST <= seed <= seeds.TRAINING_LAST for seed in made)
    assert made[0] == seeds.training_seed(0, 0, 0)


def test_validation_and_test_seeds_are_disjoint():
    assert not set(seeds.validation_seeds(100)) & set(seeds.TEST)
    assert seeds.validation_seeds(3) == (20000, 20001, 20002)


def test_a_folded_seed_is_a_training_seed_and_small_ones_are_their_own():
    small = [0, 10_000, seeds.TRAINING_FIRST, 2**31 - 1]
    assert [seeds.fold_seed(seed) for seed in small] == small
    assert seeds.fold_seed(2**31) == 2**31 % (2**31 - seeds.TRAINING_FIRST) + seeds.TRAINING_FIRST
    many = {seeds.fold_seed(seeds.training_seed(1, generation, 0)) for generation in range(1000)}
    assert len(many) > 990
    assert all(seeds.TRAINING_FIRST <= each < 2**31 for each in many)
