"""Take Cover on a fleet: the same bits on any, and nothing is left of games however their processes end."""

import os
import signal
from contextlib import suppress
from pathlib import Path
from time import monotonic, sleep

import pytest

from dreamfleet.worker.worlds.takecover.game import TakeCover
from dreamfleet.worker.worlds.takecover.process import ARGUMENTS, FOLDER_PREFIX, GAME_NAME_FLAG
from tests.support.doom import games, has_ended, name_of_game, shared_files
from tests.support.processes import DEADLINE
from tests.support.same_bits import evolve

pytestmark = [pytest.mark.slow, pytest.mark.needs_doom]
RUN = ("--task", "takecover", "--bundle", "none", "--horizon", 525)
ROUNDS = 13  # of four kills each


def test_any_fleet_gives_the_same_bits_and_the_verbs_take_the_run(processes):
    settings = (*RUN, "--population", 6, "--episodes", 2, "--generations", 2, "--evaluate-every", 1,
                "--evaluation-episodes", 4)  # fmt: skip
    assert evolve(processes, "one", 1, *settings) == evolve(processes, "two", 2, *settings)
    runs = ("--runs-dir", processes.runs)
    code, out, err = processes.call("verify", "candidate", "one", *runs, "--candidate", "1/3")
    assert (code, out.count("same bits")) == (0, 2), err
    code, out, err = processes.call("evaluate", "--controller", "one", *runs, "--episodes", 3)
    assert (code, " 750" in out) == (0, True), err
    for verb, more in (("record", ("--steps", 5)), ("live", ("--seconds", 1))):
        video = processes.folder / f"{verb}.mp4"
        code, out, err = processes.call(verb, "--controller", "one", *runs, *more, "--out", video)
        assert (code, video.exists()) == (0, True), err


def test_fifty_kills_of_slots_and_workers_leave_no_game_and_no_file(processes, temporary):
    processes.coordinator(*RUN, "--population", 64, "--episodes", 8, "--generations", 10**4, "--evaluate-every", 0)
    seen, kills = {}, 0  # games by process, each with its descriptor and name
    for number in range(ROUNDS):
        workers = [processes.worker("--slots", 2, "--name", f"w{number}-{index}") for index in range(2)]
        playing = wait_for_games(processes, seen, 4)
        by_worker = {each.popen.pid: [] for each in workers}
        for slot in {parent_of(game) for game in playing} - {None}:
            with suppress(KeyError):
                by_worker[parent_of(slot)].append(slot)
        for each in workers:
            os.kill(by_worker[each.popen.pid][0], signal.SIGKILL)
            each.popen.kill()
            kills += 2
    assert kills >= 50
    wait_for_games(processes, seen, 0)
    assert all(has_ended(descriptor) for descriptor, _ in seen.values())
    assert len(seen) >= 2 * ROUNDS
    names = {name for _, name in seen.values()} | names_in(temporary)
    game = TakeCover()  # removes what kills amid a start left
    game.reset(seed=1)
    game.close()
    assert (games(environment=marker(processes)), list(temporary.glob(f"{FOLDER_PREFIX}*"))) == (set(), [])
    assert [file for name in names for file in shared_files(name)] == []


def marker(processes):
    """What the environment of all processes of this test has."""
    return str(processes.cache).encode()


def wait_for_games(processes, seen, count):
    """Wait until so many games run; note all that were seen."""
    until = monotonic() + DEADLINE
    while len(running := games(environment=marker(processes))) != count:
        assert monotonic() < until, running
        for game in running - set(seen):
            with suppress(OSError, ValueError):  # it has just ended
                seen[game] = os.pidfd_open(game), name_of_game(game)
        sleep(0.01)
    return running


def parent_of(process):
    with suppress(OSError):  # it has ended
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].split()[1])
    return None


def names_in(temporary):
    """Names of the games whose start was killed."""
    found = set()
    for path in temporary.glob(f"*/{ARGUMENTS}"):
        words = path.read_text().splitlines()
        if GAME_NAME_FLAG in words:
            found.add(words[words.index(GAME_NAME_FLAG) + 1])
    return found
