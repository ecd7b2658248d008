"""What a verb says to type next can be typed: each hint is run, or at least parsed, as it stands."""

import shlex

import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.cli.command_line import parse_flags
from tests.support.drives import write_drives
from tests.support.verbs import find_verb

SHORT = {"train vae": ["--updates", "1"], "train mdnrnn": ["--updates", "1"], "bundle": ["--recorded", "0"]}


def hints(capsys):
    """The words of each next command, without the program."""
    found = [line for line in capsys.readouterr().err.splitlines() if line.startswith("next: ")]
    words = [shlex.split(line.removeprefix("next: ")) for line in found]
    return [each[each.index("dreamfleet") + 1 :] if "dreamfleet" in each else each[1:] for each in words]


def check(words):
    """Parse a command, which refuses a wrong flag."""
    parse_flags(*find_verb(words))


def run(words, *more):
    assert command_line.main([*map(str, words), *map(str, more)]) == 0


@pytest.mark.slow
def test_the_stages_of_a_world_model_lead_from_one_to_the_next(tmp_path, capsys):
    write_drives(tmp_path, episodes=4, steps=6)
    words, said = ["collect", "--data", tmp_path, "--episodes", 4, "--jobs", 1, "--preset", "tiny"], []
    while len(said) < 5:
        run(words, *SHORT.get(" ".join(map(str, words[:2])), SHORT.get(words[0], [])))
        words, *others = hints(capsys)
        said.append(words[0] if words[0] != "train" else f"train {words[1]}")
    assert said == ["train vae", "encode", "train mdnrnn", "bundle", "inspect"]
    for each in (words, *others):
        check(each)
    assert [each[0] for each in others] == ["coordinator"]
    assert (tmp_path / "tiny.zip").is_file()

    run(["collect", "--data", tmp_path, "--episodes", 4, "--jobs", 1])
    assert hints(capsys) == [["encode", "--data", str(tmp_path)]], "the VAE is there"
    run(["encode", "--data", tmp_path, "--json"])
    assert not hints(capsys)
    write_drives(tmp_path / "other", episodes=4, steps=6)
    run(["pipeline", "--data", tmp_path / "other", "--preset", "tiny", "--scale", 0.001, "--jobs", 1, "--yes"])
    assert [each[0] for each in hints(capsys)] == ["inspect", "coordinator"], "once, at the end"


@pytest.mark.slow
def test_a_judged_agent_is_recorded_and_the_other_way_round(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(["evaluate", "--controller", "random", "--task", "car-racing", "--episodes", 1, "--jobs", 1])
    (words,) = hints(capsys)
    assert words[:3] == ["record", "--controller", "random"]
    run(words, "--steps", 3)
    assert (tmp_path / "drive.mp4").is_file()
    (words,) = hints(capsys)
    assert words == ["evaluate", "--controller", "random", "--task", "car-racing"]
    check(words)
