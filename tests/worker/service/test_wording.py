"""What a worker that waits or is refused says."""

import re

import pytest

from dreamfleet.common.errors import RefusedError
from dreamfleet.common.host import processes
from dreamfleet.common.transport.session import Network
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.wording import WAIT_LIMIT, WaitingText, describe_refusal

ADDRESS = "tcp/home.example:7447"
TASK = RefusedError("start it", ("--task", "my:World"))


@pytest.fixture(autouse=True)
def program(monkeypatch):
    """The program's name in printed commands."""
    monkeypatch.setattr(processes.sys, "argv", ["dreamfleet"])


@pytest.mark.parametrize(
    ("flag", "typed", "whole"),
    [
        (TASK.flag, ("--run", "night", "--connect", ADDRESS), f"--run night --connect {ADDRESS} --task my:World"),
        (TASK.flag, ("--task", "a:A", "b:B", "--any"), "--any --task a:A b:B my:World"),
        (TASK.flag, ("--task=a:A", "--slots=2"), "--slots=2 --task a:A my:World"),
        (TASK.flag, ("--name", "it's"), "--name 'it'\"'\"'s' --task my:World"),
        (("--run", "day"), ("--run", "old", "--join", "f"), "--join f --run day"),  # which replaces the one named
    ],
)
def test_a_refusals_command_has_all_flags_that_were_typed(flag, typed, whole):
    found = describe_refusal(RefusedError("start it", flag), ("worker", *typed))
    assert found == f"start it: `dreamfleet worker {whole}`"


def test_a_refusal_without_a_command_stays_and_a_program_names_the_lacking_flag_alone():
    hostile = RefusedError("start `dreamfleet worker --task a` `rm -r x`")
    assert describe_refusal(hostile, ("worker", "--any")) == str(hostile)
    assert describe_refusal(TASK, ()) == str(TASK) == "start it: `dreamfleet worker --task my:World`"


def said(texts, times, **how):
    return [text for now in times if (text := texts.next(now, **how))]


def test_a_worker_that_is_early_is_not_called_revoked_at_once(monkeypatch):
    texts = WaitingText(WorkerConfig(run="night"), Network(connect=(ADDRESS,)), 5.0)
    monkeypatch.setattr(texts, "_secured", True)
    early, later = said(texts, (5.0, 5.0 + WAIT_LIMIT), answered=True)
    assert "--join" not in early
    assert "--join" in later


@pytest.mark.parametrize(
    ("answered", "awaited", "flag"), [(True, {"night", "day"}, "--connect"), (False, set(), "--listen")]
)
def test_a_waiting_worker_names_the_address_and_what_is_there_at_once_and_what_to_start_later(answered, awaited, flag):
    texts = WaitingText(WorkerConfig(run="night"), Network(connect=(ADDRESS,)), 5.0)
    times, there = (5.0, 6.0, 5.0 + WAIT_LIMIT, 500.0), lambda: ["night", "day"]
    first, second = said(texts, times, answered=answered, others=there)
    assert f" {ADDRESS}" in first
    assert {"night", "day"} & set(first.split()) == awaited
    assert re.search(f" {ADDRESS}.* 30 .*dreamfleet coordinator --run night {flag} {ADDRESS}$", second)


@pytest.mark.parametrize(("run", "awaited"), [(None, []), ("night", ["night"])])
def test_a_worker_whose_run_has_ended_says_so_once_and_waits_for_a_named_run_alone(run, awaited):
    texts = WaitingText(WorkerConfig(run=run), Network(connect=(ADDRESS,)), 0.0, "run night ended after 2 generations")
    (text,) = said(texts, (0.0, 1.0, 500.0), answered=False)
    ended, _, waits = text.partition(";")
    assert ended == "run night ended after 2 generations"
    assert re.findall("night", waits) == awaited
    assert waits.endswith(f" {ADDRESS}")
