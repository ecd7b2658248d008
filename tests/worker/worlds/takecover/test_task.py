"""Take Cover as a task and as an environment. Tests game.py, options.py, process.py
and common/host/parent_death.py."""

import ctypes
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet import ControllerShape, Scorer, TaskSpec
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.common.runs.seeds import fold_seed
from dreamfleet.worker.service.child import ChildReady, ScorerArguments
from dreamfleet.worker.service.child_process import ChildProcess
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithOptions, TaskWithPolicies
from dreamfleet.worker.tasks.registry import find_task, find_world
from dreamfleet.worker.worlds.takecover import process
from dreamfleet.worker.worlds.takecover.game import FAR_TURNS, LEFT, LIMIT, RIGHT, STAY, TakeCover
from dreamfleet.worker.worlds.takecover.options import TakeCoverOptions
from dreamfleet.worker.worlds.takecover.process import ARGUMENTS, FOLDER_PREFIX, GAME_NAME_FLAG, SHARED_FILES
from dreamfleet.worker.worlds.takecover.task import TakeCoverTask, cut_in_thirds, pick_choice
from tests.support.bundles import write_world_bundle
from tests.support.doom import games, name_of_game, play, search_path, shared_files
from tests.support.processes import DEADLINE, ends
from tests.support.specs import described_spec
from tests.support.variants import vectors
from tests.support.world_contract import check_world

ALL_CHANGED = '{"environment": {"actions": "thirds", "crop": "30:90,0:160", "tics": 1}}'


def pictures_of(tics, actions, seed=3):
    """The pictures after each action of a game, the sum of its rewards, and how it ended."""
    game = TakeCover(tics)
    pictures, total, ends = [game.reset(seed=seed)[0]], 0.0, (False, False)
    for action in actions:
        picture, reward, *ends, _ = game.step(action)
        pictures.append(picture)
        total += reward
        if any(ends):
            break
    game.close()
    return pictures, total, tuple(ends)


def test_the_whole_screen_shows_the_same_game(doom):
    small, large = TakeCover(), TakeCover(screen=True)
    assert [game.reset(seed=11)[0].shape for game in (small, large)] == [(120, 160, 3), (480, 640, 3)]
    random, over = np.random.default_rng(4), False
    while not over:
        action = int(random.integers(3))
        one, other = (game.step(action)[1:4] for game in (small, large))
        assert one == other
        over = any(one[1:])
    small.close()
    large.close()


def test_turns_far_from_the_walls_are_a_share_of_all_turns(doom):
    game, seen = TakeCover(2), []
    for seed in (3, 4):  # the count begins anew
        game.reset(seed=seed)
        seen.append([game.step(action)[-1].get(FAR_TURNS) for action in [RIGHT] * 2 + [STAY, RIGHT, LEFT, STAY, RIGHT]])
        assert seen[-1] == [None] * 4 + [1.0] * 3
    for _ in range(60):
        game.step(RIGHT)
    assert game.step(LEFT)[-1][FAR_TURNS] == 2 / 3
    game.close()


@pytest.mark.parametrize("options", ["", ALL_CHANGED])
def test_the_task_keeps_the_contract_of_recordable_worlds_and_its_drivers_follow_the_actions(doom, options):
    task = find_task("takecover").with_options(options)
    check_world(task)
    assert all(isinstance(task, each) for each in (RecordableTask, TaskWithOptions, TaskWithPolicies))
    policy = task.policies["uniform"](np.random.default_rng(1))
    drawn = {tuple(policy.act(None).tolist()) for _ in range(20)}
    assert len(drawn) == (20 if options else 3)


def test_a_world_follows_from_its_options():
    task = find_task("takecover")
    other = task.with_options(ALL_CHANGED)
    assert (task.world.horizon, task.world.frames_per_second, task.world.dream_reward.gain) == (525, 9, 4.0)
    assert (task.world.actions.outputs, [*task.preprocessings]) == (3, ["box-64", "box-96"])
    assert (other.world.horizon, other.world.frames_per_second, other.world.dream_reward.gain) == (2100, 35, 1.0)
    names = [f"{name} of 30:90,0:160" for name in ("box-64", "box-96")]
    assert (other.world.actions.outputs, [*other.preprocessings]) == (1, names)
    assert TakeCoverOptions(tics=8).horizon == 263  # of which the last is held for 4 tics
    stay, left, right = np.eye(3, dtype=np.float32)
    mirrored = [task.world.mirror.apply(each).tolist() for each in (stay, left, right)]
    assert mirrored == [each.tolist() for each in (stay, right, left)]
    assert other.world.mirror.apply(np.float32([0.5])) == -0.5


def test_options_are_frozen_where_they_differ_from_the_defaults_also_by_flags_that_any_world_takes():
    task = TakeCoverTask()
    assert task.parse_options({}) == task.parse_options({"environment": {"tics": 4, "actions": "choices"}}) == ""
    assert task.parse_options({"environment": {"tics": 1}}) == '{"environment": {"tics": 1}}'
    changed = TakeCoverOptions.parse(ALL_CHANGED)
    assert (changed.text, changed.part) == (ALL_CHANGED, (30, 90, 0, 160))
    flags = {"environment": {"actions": "thirds"}, "skip": 1, "crop": "30:90,0:160"}
    assert task.parse_options(flags) == ALL_CHANGED


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("[]", "takecover"),
        ("{", "takecover"),
        ('{"variant": 1}', "variant"),
        ('{"environment": {"skill": 5}}', "skill.* tics, actions, crop"),
        ('{"environment": 3}', "3"),
        ('{"environment": {"tics": 0}}', "tics.* 1 .*10"),
        ('{"environment": {"tics": true}}', "tics"),
        ('{"environment": {"tics": 3}, "skip": 4}', "--skip 4 .*--environment tics=3"),
        ('{"environment": {"actions": "five"}}', "five"),
        ('{"environment": {"crop": "0:121,0:160"}}', "0:121,0:160"),
        ('{"environment": {"crop": "9:9,0:160"}}', "9:9,0:160"),
        ('{"environment": {"crop": [0, 100]}}', "0, 100"),
    ],
)
def test_other_options_are_refused(options, named):
    with pytest.raises(UsageError, match=named):
        TakeCoverTask().with_options(options)


def test_an_action_is_one_of_three():
    assert [pick_choice(row) for row in np.eye(3, dtype=np.float32)] == [STAY, LEFT, RIGHT]
    numbers = np.array([[-1], [-0.34], [-0.33], [0], [0.33], [0.34], [1]], np.float32)
    assert [cut_in_thirds(number) for number in numbers] == [LEFT, LEFT, STAY, STAY, STAY, RIGHT, RIGHT]


def test_the_environment_is_one_of_gymnasiums(doom):
    game = TakeCover()
    with pytest.warns(UserWarning, match="spec"):  # it is not registered
        check_env(game)
    game.close()


def test_an_action_held_for_four_tics_is_four_actions(doom):
    actions = [STAY, LEFT, RIGHT, RIGHT, STAY, LEFT] * 100
    held, score, ends = pictures_of(4, actions)
    each, same_score, same_ends = pictures_of(1, np.repeat(actions, 4))
    assert (score, ends) == (same_score, same_ends)
    assert ends == (True, False)  # a death
    assert score == len(each) - 1
    assert all((one == other).all() for one, other in zip(held[:-1], each[::4], strict=False))


def test_the_black_picture_of_a_death_is_never_seen(doom):
    pictures, _, ends = pictures_of(4, [STAY] * 600)
    assert ends == (True, False)
    assert all(picture.any() for picture in pictures)
    assert (pictures[-1] == pictures[-2]).all()


def test_the_limit_of_tics_is_no_death(fake_doom):
    pictures, score, ends = pictures_of(8, [RIGHT] * 600)  # the stand-in lives on
    assert (len(pictures) - 1, score, ends) == (263, float(LIMIT), (False, True))


def test_a_long_seed_is_folded_and_a_reset_without_one_goes_on(doom):
    def play(seed):
        game.reset(seed=seed)
        return b"".join(game.step(RIGHT)[0].tobytes() for _ in range(120))

    game, long = TakeCover(), 2**53 - 1
    assert play(long) == play(fold_seed(long)) != play(long - 1)
    first, again = ([play(seed) for seed in (1, None, None)][1:] for _ in range(2))
    assert first == again
    assert first[0] != first[1]
    game.close()


def test_a_run_without_a_world_model_sees_a_band_of_pixels_and_whoever_watches_the_games_picture(doom):
    about = describe_task("takecover", {"environment": {"tics": 1}})
    packages = "numpy", "onnxruntime", "vizdoom"
    assert (about.observations, about.outputs, about.packages) == (128, 3, packages)
    assert json.loads(about.options) == {"environment": {"tics": 1}}
    scorer = Scorer(described_spec("takecover", 525, environment={"tics": 2}))
    parameters = np.random.default_rng(1).normal(size=387).astype(np.float32)
    score = scorer.score("score", parameters, 2**40)
    assert score == scorer.score("score", parameters, 2**40)
    assert 0 < score.fitness <= 2 * score.steps < score.fitness + 2
    assert scorer.drawn_by == "vizdoom"
    scorer.close()
    environment = TakeCoverTask().make_watched_environment(Assignment(described_spec("takecover")))
    assert games(os.getpid()) == set(), "what nobody resets starts no game"
    observation, _ = environment.reset(seed=1)
    assert (observation.shape, environment.render().shape) == ((128,), (120, 160, 3))
    environment.close()


@pytest.mark.parametrize("options", ["", ALL_CHANGED])
def test_a_world_model_brings_its_options(doom, tmp_path, options):
    task = find_world("takecover", options)
    facts = task.world.facts(RewardFacts("survival", task.world.dream_reward.gain), EndRule("drawn"), options)
    (preprocessing, *_), path = task.preprocessings, tmp_path / "takecover.zip"
    bundle = write_world_bundle(path, facts, "takecover", preprocessing=preprocessing)
    assert (facts.score_word, facts.marks, facts.horizon) == ("game", (750.0,), task.world.horizon)
    scorer, (parameters,) = Scorer(TaskSpec("takecover", bundle.sha256, 5, 0), bundle), vectors(bundle, 1, scale=1.0)
    score = scorer.score("score", parameters, 2**40)
    assert (score.steps, score.fitness) == (5, 5 * facts.reward.gain)
    assert score == scorer.score("score", parameters, 2**40)
    scorer.close()


def test_without_the_package_the_task_is_known_and_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "vizdoom", None)
    assert find_task("takecover").world.threshold == 750
    with pytest.raises(UsageError, match=r"'dreamfleet\[doom\]'"):
        Scorer(described_spec("takecover"))


@pytest.mark.add_on
def test_the_list_of_tasks_names_the_missing_package(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "vizdoom", None)
    assert main(["tasks", "--json"]) == 0
    found = {row["task"]: row["here"] for row in json.loads(capsys.readouterr().out)}
    assert "'dreamfleet[doom]'" in found["takecover"]


PROGRAM = "from tests.support.doom import play; print(play(range(100)), play((5, 1)))"
DIGESTS = {  # of seeds, with vizdoom 1.3.2
    1: "d33d9ca85ad5bc8bbfffb4aa9f652b45f7abcdf4a2fd8a25e51b218670476fec",
    2: "6851339951c322da322e6289673f2f30da882d9e4912a840af27d6e47c13e783",
    3: "43e0b45544e746f202f458574b31ffb293e6176a076ccc77bf3a1f8f0353ac9e",
}


@pytest.mark.needs_doom
@pytest.mark.parametrize("seed", DIGESTS)
def test_the_pictures_and_rewards_of_a_seed_are_the_known_ones(seed):
    assert play((seed,)) == DIGESTS[seed]


@pytest.mark.slow
@pytest.mark.needs_doom
def test_random_play_of_a_hundred_seeds_is_equal_in_two_processes():
    programs = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": search_path()}
        )
        for _ in range(2)
    ]
    found = [program.communicate(timeout=DEADLINE)[0].split() for program in programs]
    assert found[0] == found[1]
    assert found[0][1] == play((5, 1))  # after others, or first


PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # of Linux's prctl
PLAYING = """
import os, signal, sys
from dreamfleet.worker.worlds.takecover.game import TakeCover
game = TakeCover(4)
game.reset(seed=1)
print("plays", flush=True)
sys.stdin.readline()
"""
KILL = "os.kill(os.getpid(), signal.{})"


def start_program(ending, **more):
    return subprocess.Popen(
        [sys.executable, "-c", PLAYING + ending], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": search_path()}, **more,
    )  # fmt: skip


def folders(temporary):
    """The folders in which games were started; other libraries have files of their own there."""
    return list(temporary.glob(f"{FOLDER_PREFIX}*"))


def only_game(parent):
    """Descriptor and name of the one game of this process."""
    (game,) = games(parent)
    return os.pidfd_open(game), name_of_game(game)


@pytest.fixture
def game(doom, tmp_path, monkeypatch):
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    game = TakeCover(4)
    game.reset(seed=1)
    yield game
    game.close()


def test_nothing_is_left_while_a_game_plays_nor_afterwards(temporary, game):
    running, name = only_game(os.getpid())
    assert (list(Path().iterdir()), folders(temporary), shared_files(name)) == ([], [], [])
    game.step(0)
    game.close()
    assert ends(running)
    assert (list(Path().iterdir()), folders(temporary), shared_files(name)) == ([], [], [])


@pytest.mark.parametrize("ending", [KILL.format("SIGKILL"), KILL.format("SIGTERM"), "os._exit(3)", "sys.exit()"])
def test_a_game_ends_with_its_process_however_that_ends(doom, temporary, tmp_path, ending):
    with start_program(ending, cwd=tmp_path) as program:
        assert program.stdout.readline() == "plays\n"
        running, name = only_game(program.pid)
        program.communicate("\n", timeout=DEADLINE)
    assert ends(running)
    assert (folders(temporary), shared_files(name)) == ([], [])


def test_a_game_ends_with_its_slot(doom, temporary):
    events = queue.SimpleQueue()
    spec = TaskSpec("takecover", "", horizon=525, patience=0, controller=ControllerShape(128, 3))
    child = ChildProcess(ScorerArguments(spec, None, ("takecover",)), events.put)
    assert isinstance(events.get(timeout=DEADLINE), ChildReady)
    running, name = only_game(child.pid)
    os.kill(child.pid, signal.SIGKILL)
    assert ends(running)
    child.close()
    assert (folders(temporary), shared_files(name)) == ([], [])


def test_signals_to_all_processes_of_a_service_do_not_end_a_game(game):
    (running,) = games(os.getpid())
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(running, number)
    assert (game.step(0)[1], games(os.getpid())) == (4.0, {running})


@pytest.mark.needs_doom
def test_a_game_outlives_the_thread_that_started_it():
    game = TakeCover(4)
    starting = threading.Thread(target=lambda: game.reset(seed=1))
    starting.start()
    starting.join()
    assert [game.step(0)[1] for _ in range(10)] == [4.0] * 10
    game.close()


def test_a_current_folder_that_cannot_be_written_is_no_crash(doom, temporary, tmp_path):
    current = tmp_path / "current"
    current.mkdir(mode=0o555)
    ending = 'print(os.access(".", os.W_OK), game.step(0)[1])'
    drop = lambda: ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)  # noqa: E731 - a superuser's right
    with start_program(ending, cwd=current, preexec_fn=drop) as program:
        out, _ = program.communicate("\n", timeout=DEADLINE)
    assert (program.returncode, out) == (0, "plays\nFalse 4.0\n")


def test_temporary_files_that_cannot_be_programs_are_named(doom, temporary, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.X_OK)  # as on a file system without programs
    with pytest.raises(UsageError, match=str(temporary)):
        TakeCover(4).reset(seed=1)
    assert folders(temporary) == []


def test_a_game_that_does_not_start_is_an_error_and_leaves_nothing(fake_doom, temporary, monkeypatch):
    monkeypatch.setattr(sys.modules["vizdoom"], "__file__", "/nowhere/vizdoom.so")
    game = TakeCover(4)
    with pytest.raises(Exception, match="ViZDoom"):
        game.reset(seed=1)
    game.close()
    assert (folders(temporary), games(os.getpid())) == ([], set())


def test_a_crashed_game_is_an_error_and_the_next_episode_starts_another(game):
    first, _ = game.reset(seed=1)
    running, _ = only_game(os.getpid())
    signal.pidfd_send_signal(running, signal.SIGKILL)
    assert ends(running)
    with pytest.raises(Exception, match=r"crash|not running"):
        game.step(0)
    assert (game.reset(seed=1)[0] == first).all()


def test_what_a_killed_start_left_is_removed_by_the_next(temporary, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "SHARED_MEMORY", tmp_path)
    with subprocess.Popen(["true"]) as ended:
        pass
    for owner, name in ((ended.pid, "abcdefghij"), (os.getpid(), "0123456789")):
        folder = temporary / f"{FOLDER_PREFIX}{owner}-xyz"
        folder.mkdir()
        (folder / ARGUMENTS).write_text(f"-skill\n4\n{GAME_NAME_FLAG}\n{name}\n-nosound\n")
        for each in SHARED_FILES:
            (tmp_path / f"{each}{name}").touch()
    (temporary / f"{FOLDER_PREFIX}{ended.pid}-early").mkdir()
    (temporary / f"{FOLDER_PREFIX}mine").mkdir()
    process.remove_leftovers()
    assert {each.name for each in temporary.iterdir()} == {f"{FOLDER_PREFIX}{os.getpid()}-xyz", f"{FOLDER_PREFIX}mine"}
    assert {each.name for each in tmp_path.iterdir()} - {"temporary"} == {f"{each}0123456789" for each in SHARED_FILES}


def test_a_launcher_takes_folders_with_any_name(tmp_path):
    folder = tmp_path / "it's a $folder"
    folder.mkdir()
    launcher = folder / "launcher"
    launcher.write_text(process.launcher_text(folder, Path("/bin/pwd"), os.getpid()))
    launcher.chmod(0o700)
    done = subprocess.run([launcher, "-P"], capture_output=True, text=True, check=True, timeout=DEADLINE)
    assert done.stdout == f"{folder}\n"
    assert (folder / ARGUMENTS).read_text() == "-P\n"
