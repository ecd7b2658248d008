"""The mask over Take Cover's pictures. Tests masking.py."""

import numpy as np
import pytest

from dreamfleet.worker.worlds.takecover.game import TakeCover
from dreamfleet.worker.worlds.takecover.masking import OTHER_GAME, MaskedTakeCover, find_fireballs, paint_out

WALL, IMP, FIRE, ORANGE = (110, 85, 60), (180, 120, 60), (250, 240, 160), (220, 140, 40)


def test_a_fireball_is_painted_out_and_an_imp_is_not():
    wall = np.full((120, 160, 3), WALL, np.uint8)
    wall[58:64, 30:33] = IMP
    picture = wall.copy()
    picture[56:61, 80:85] = ORANGE
    picture[57:60, 81:84] = FIRE
    picture[60:63, 0:3] = FIRE  # at the left edge
    picture[10:13, 50:53] = FIRE  # of the sky
    mask = find_fireballs(picture)
    assert mask[55:62, 79:86].all()
    assert mask[59:64, 0:4].all()
    assert mask.sum() == 7 * 7 + 5 * 4
    painted = paint_out(picture, mask)
    assert (painted[14:] == wall[14:]).all()


def screen():
    return TakeCover(1, screen=True, labelled=True)


def play(game, seed):
    pictures, rewards = [game.reset(seed=seed)[0]], []
    for step in range(120):
        picture, reward, *ends, _ = game.step(step // 9 % 3)
        pictures.append(picture)
        rewards.append(reward)
        if any(ends):
            break
    game.close()
    return np.stack(pictures), rewards


def test_on_a_screen_the_game_says_what_is_a_fireball(fake_doom):
    seen, hidden, foreign = (
        play(game, 7)[0] for game in (screen(), MaskedTakeCover(screen(), None), MaskedTakeCover(screen(), screen()))
    )
    other = play(screen(), 7 + OTHER_GAME)[0]
    mask, there = (np.zeros((480, 640), bool) for _ in range(2))
    mask[7:27, :9] = there[(7 + OTHER_GAME) % 100 :][:20, :9] = True
    assert (hidden[:, ~mask] == seen[:, ~mask]).all()
    assert (hidden[0] == paint_out(seen[0], mask)).all()
    assert (foreign[0][there] == other[0][there]).all()
    assert (foreign[:, ~(mask | there)] == seen[:, ~(mask | there)]).all()


@pytest.mark.needs_doom
def test_no_fireball_is_left_on_a_screen_of_the_same_game():
    seen, rewards = play(screen(), 7)
    hidden, same = play(MaskedTakeCover(screen(), None), 7)
    _, again = play(MaskedTakeCover(screen(), screen()), 7)
    assert rewards == same == again
    white = [(each[:, :400].min(axis=3) > 150).sum(axis=(1, 2)).max() for each in (seen, hidden)]
    assert white[1] < 20 < 200 < white[0]  # the eyes of imps


@pytest.mark.needs_doom
def test_a_masked_game_is_the_same_game():
    seen, rewards = play(TakeCover(4), 7)
    assert find_fireballs(seen[40:].reshape(-1, 160, 3)).any()
    hidden, same = play(MaskedTakeCover(TakeCover(4), None), 7)
    foreign, again = play(MaskedTakeCover(TakeCover(4), TakeCover(4)), 7)
    assert rewards == same == again
    fire = [sum(find_fireballs(each).any() for each in shown) for shown in (seen, hidden, foreign)]
    assert fire[1] <= 2 < min(fire[0], fire[2])
    assert (foreign == play(MaskedTakeCover(TakeCover(4), TakeCover(4)), 7)[0]).all()
