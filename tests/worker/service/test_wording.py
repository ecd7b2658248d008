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
    ("typed", "whole"),
    [
        (("--run", "night", "--connect", ADDRESS), f"--run night --connect {ADDRESS} --task my:World"),
        (("--task", "a:A", "b:B", "--any"), "--any --task a:A b:B my:World"),
        (("--task=a:A", "--slots=2"), "--slots=2 --task a:A my:World"),
        (("--name", "it's"), "--name 'it'\"'\"'s' --task my:World"),
    ],
)
def test_a_refusals_command_has_all_flags_that_were_typed(typed, whole):
    assert describe_refusal(TASK, ("worker", *typed)) == f"start it: `dreamfleet worker {whole}`"


def test_a_command_that_chooses_a_run_replaces_the_one_that_was_named():
    error = RefusedError("choose one", ("--run", "day"))
    typed = ("worker", "--run", "old", "--join", "f")
    assert describe_refusal(error, typed) == "choose one: `dreamfleet worker --join f --run day`"


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
    ("answered", "awaited", "flag"), [(True, "run night", "--connect"), (False, "a coordinator", "--listen")]
)
def test_a_waiting_worker_names_the_address_at_once_and_what_to_start_later(answered, awaited, flag):
    texts = WaitingText(WorkerConfig(run="night"), Network(connect=(ADDRESS,)), 5.0)
    first, second = said(texts, (5.0, 6.0, 5.0 + WAIT_LIMIT, 500.0), answered=answered)
    assert re.search(f"{awaited}.* {ADDRESS}$", first)
    assert re.search(f" {ADDRESS}.* 30 .*dreamfleet coordinator --run night {flag} {ADDRESS}$", second)


def test_a_worker_whose_run_has_ended_says_so_once():
    texts = WaitingText(WorkerConfig(), Network(connect=(ADDRESS,)), 0.0, "run night ended after 2 generations")
    (text,) = said(texts, (0.0, 1.0, 500.0), answered=False)
    assert re.search(f"run night ended after 2 generations.* {ADDRESS}$", text)


def test_a_worker_of_a_named_run_waits_for_it_alone():
    texts = WaitingText(WorkerConfig(run="night"), Network(connect=(ADDRESS,)), 0.0, "run night ended: 2 generations")
    (text,) = said(texts, (0.0, 1.0), answered=False)
    assert re.search(f"run night ended: 2 generations.* run night.* {ADDRESS}$", text)


def test_a_worker_that_waits_for_its_run_names_those_that_are_served_there():
    waiting = WaitingText(WorkerConfig(run="mine"), Network(connect=("tcp/a:1",)), 0.0)
    said = waiting.next(0.0, answered=True, others=lambda: ["mine", "night"])
    assert re.search("run mine.* tcp/a:1.* night$", said)
