"""Small things in dreams that go on from recorded states: of a known world, whose exact dream shows them all."""

import json
from itertools import count

import numpy as np
import pytest

from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.worker.addons.inspection import dreamt_spots, mdnrnn_sections
from dreamfleet.worker.addons.inspection import verb as inspect
from dreamfleet.worker.addons.inspection.dreamt_spots import AHEAD, CODE, HELD, SpotShares, measure_dreamt_spots
from dreamfleet.worker.addons.inspection.encoded_rollout import EncodedRollout
from dreamfleet.worker.worldmodel.inference import DreamOutput, NoiseSize
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_world_bundle
from tests.support.pixel_world import DodgeTask
from tests.support.verbs import run_verb

STEPS, NOWHERE = 20, -1
DREAMS = ("dream_0.5", "dream_1.0")
SMALL, LARGE = dreamt_spots.SIZES


def picture_at(place):
    """Noise, and a ball of 9 pixels at its place."""
    picture = np.random.default_rng(int(place) + 1).integers(20, 60, (64, 64, 3), np.uint8)
    row, column = 4 * (int(place) // 15), 4 * (int(place) % 15)
    if place != NOWHERE:
        picture[row : row + 3, column : column + 3] = 240
    return picture


def see(places):
    return np.stack([picture_at(place) for place in places])


def drive_of(seed, steps=STEPS, opening=0):
    """From place 0 on, each step moves the ball by its action."""
    action = np.random.default_rng(seed).integers(1, 4, (steps, 1)).astype(np.float32)
    place = np.cumsum([[0], *action[:-1]], axis=0).astype(np.float32)
    return EncodedRollout(see(place[:, 0]), place, place, action, np.zeros(steps), "", opening)


class Known:
    """A decoder without loss, and a dream whose state alone knows the place."""

    chance = NoiseSize(1, 1, 0.0)

    def __init__(self, _bundle):
        pass

    def decode(self, latent):
        return see(latent[:, 0])

    def zero_state(self, rows):
        return np.zeros((rows, 1), np.float32)

    def advance(self, _latent, action, state):
        return state + action

    def place(self, _latent, state):
        return state

    def imagine(self, latent, action, state, _uniform, _normal, _temperature, _mask):
        after = state + action
        nothing = np.zeros(len(latent), np.float32)
        return DreamOutput(action, self.place(latent, after), after, nothing, nothing)


@pytest.fixture
def known(monkeypatch):
    """Put a world model, by its class, in the place of a bundle's."""

    def put(model):
        for name in ("Decoder", "DreamStep"):
            monkeypatch.setattr(dreamt_spots, name, model)
        monkeypatch.setattr(mdnrnn_sections, "DreamStep", model)
        monkeypatch.setattr(mdnrnn_sections, "RewardLabel", lambda _bundle: type("", (), {"write": lambda *_given: 0}))

    return put


def by_source(found, size=SMALL):
    """The figures of each source and number of decisions: shown, of how many; true, of how many."""
    return {
        (each.source, each.decisions): (each.shown, each.true_spots, each.true, each.source_spots)
        for each in found.shares
        if (each.least, each.most) == size
    }


def test_an_exact_dream_shows_every_ball_and_no_other_and_a_held_picture_none(known):
    known(Known)
    found = measure_dreamt_spots(None, [drive_of(1), drive_of(2)])
    states = 2 * (STEPS - max(AHEAD))
    assert (found.drives, found.states) == (2, states)
    exact, held = (1.0, states, 1.0, states), (0.0, states, 0.0, states)
    expected = {(source, ahead): exact for source in (CODE, *DREAMS) for ahead in AHEAD}
    assert by_source(found) == expected | {(HELD, ahead): held for ahead in AHEAD}
    assert set(by_source(found, LARGE).values()) == {(None, 0, None, 0)}


def test_a_dream_that_forgets_shows_nothing_and_one_that_stands_still_as_much_as_a_held_picture(known):
    for place, expected in (
        (lambda _model, latent, _state: np.full_like(latent, NOWHERE), (0.0, 12, None, 0)),
        (lambda _model, latent, _state: latent, (0.0, 12, 0.0, 12)),
    ):
        known(type("Faulty", (Known,), {"place": place}))
        found = by_source(measure_dreamt_spots(None, [drive_of(1)]))
        assert {found[source, ahead] for source in DREAMS for ahead in AHEAD} == {expected}
        assert found[CODE, 8] == (1.0, 12, 1.0, 12)


def test_drives_are_taken_until_there_are_enough_states_and_of_more_states_an_even_choice(known, monkeypatch):
    known(Known)
    monkeypatch.setattr(dreamt_spots, "STATES", 18)
    monkeypatch.setattr(dreamt_spots, "STARTS", 16)
    taken = []
    drives = (taken.append(seed) or drive_of(seed, STEPS if seed else 8) for seed in count())
    found = measure_dreamt_spots(None, drives)
    assert (taken, found.drives, found.states) == ([0, 1, 2], 2, 16), "the first is too short"
    assert by_source(found)["dream_1.0", 8] == (1.0, 16, 1.0, 16)
    assert measure_dreamt_spots(None, [drive_of(1, opening=STEPS - 8)]) is None


def test_few_spots_are_measured_but_not_drawn(known, monkeypatch):
    known(Known)
    drawn = []
    monkeypatch.setattr(dreamt_spots, "render_png", drawn.append)
    section = dreamt_spots.dreamt_spots_section(None, [drive_of(1), drive_of(2)])
    assert section.figures["dreamt_spots"]["states"] == 24
    lines = [[np.isfinite(line.get_ydata()).tolist() for line in panel.get_lines()] for panel in drawn[0].axes]
    assert lines == [[[shown] * len(AHEAD)] * 4 for shown in (True, False) * 2]


@pytest.mark.slow
def test_the_verbs_json_has_the_shares_of_a_bundle(tmp_path, capsys):
    facts = DodgeTask.world.facts(RewardFacts("survival"), EndRule("drawn"))
    rnn = MDNRNNConfig(latent=5, hidden=8, reward="none", done=True)
    layers = VAEConfig(latent=5, channels=(4, 4, 4, 8))
    bundle = write_world_bundle(tmp_path / "dodge.zip", facts, vae=layers, rnn=rnn)
    words = (bundle.path, "--steps", 12, "--out", tmp_path / "page", "--json")
    assert run_verb(inspect, *words, runs_dir=tmp_path) == 0
    found = json.loads(capsys.readouterr().out)["dreamt_spots"]
    assert found["drives"] > 1, "one drive has too few states"
    shares = [SpotShares(**each) for each in found["shares"]]
    assert {each.source for each in shares} == {CODE, HELD, *DREAMS}
    assert len(shares) == 4 * len(AHEAD) * 2
    assert all(each.shown is None or 0 <= each.shown <= 1 for each in shares)
