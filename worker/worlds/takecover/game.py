"""Take Cover as a gymnasium environment on ViZDoom's `DoomGame`, and what is seen of it without a world model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import install_command_for
from dreamfleet.common.runs.seeds import fold_seed
from dreamfleet.worker.worlds.takecover.process import start_game

HEIGHT, WIDTH = 120, 160  # of the game's picture
SCREEN = 480, 640  # height and width of what a person sees
TICS_PER_SECOND = 35
WALLS, FAR = (16.0, 752.0), 120.0  # where the player's side ends, and how far from there a turn shows that it sees
FAR_TURNS = "share_of_turns_far_from_walls"  # in `info`, once it has turned
LIMIT = 2100  # tics of an episode at most: a minute
SKILL = 4  # the one to which published scores fit
FIREBALL = "DoomImpBall"  # the game's name of one, and of its explosion
STAY, LEFT, RIGHT = range(3)
BUTTONS = ([0, 0], [1, 0], [0, 1])  # pressed for each action
FIRST_ROW, ROWS, COLUMNS = 48, 4, 32  # of the band: its first row in the picture, and its numbers
CELL = (6, WIDTH // COLUMNS)  # rows and columns of the picture for each of its numbers
BAND = ROWS * COLUMNS
Pixels = NDArray[np.uint8]
Floats = NDArray[np.float32]


class TakeCover(gymnasium.Env[Pixels, int]):
    """Observes uint8 `(120, 160, 3)`; an action stays, goes left or goes right for `tics` tics; +1 for each tic lived.

    With `screen` it observes what a person sees, `(480, 640, 3)`: the status bar too, and red after a hit. With
    `labelled` the game says in `fireballs` which pixels are theirs.

    `terminated` is a death, `truncated` the limit of 2,100 tics. The picture after a death is the one before it: the
    game itself shows a black one. Equal seeds and actions give equal bits, whatever was played before. A seed of more
    than 31 bits is folded. The game's process starts with the first reset, and again after it crashed.

    `UsageError` without the package vizdoom.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": TICS_PER_SECOND}  # noqa: RUF012 - gymnasium's own form
    observation_space = spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    action_space = spaces.Discrete(len(BUTTONS))  # type: ignore[assignment] # its numbers are NumPy's
    render_mode = "rgb_array"
    drawn_by = "vizdoom"

    def __init__(self, tics: int = 1, *, screen: bool = False, labelled: bool = False) -> None:
        try:
            import vizdoom
        except ModuleNotFoundError as error:
            remedy = install_command_for("vizdoom")
            raise UsageError(f"Take Cover needs the package vizdoom, which is not here: {remedy}") from error
        self._vizdoom: Any = vizdoom
        self._tics, self._screen, self._labelled = tics, screen, labelled
        self._game: Any = None
        self._lived = self._turns = self._far_turns = 0
        self._direction = STAY
        self._picture: Pixels = np.zeros((*(SCREEN if screen else (HEIGHT, WIDTH)), 3), np.uint8)
        self.fireballs: NDArray[np.bool_] | None = None
        if screen:
            self.observation_space = spaces.Box(0, 255, self._picture.shape, np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None  # noqa: ARG002 - there are none
    ) -> tuple[Pixels, dict[str, Any]]:  # fmt: skip
        """Begin the episode of this seed, or without one an episode that follows from the last seed."""
        super().reset(seed=seed)
        if self._game is None or not self._game.is_running():
            self.close()
            self._game = self._start()
        self._game.set_seed(int(self.np_random.integers(2**31)) if seed is None else fold_seed(seed))
        self._game.new_episode()
        self._lived = self._turns = self._far_turns = 0
        self._direction = STAY
        return self._observe(), {}

    def step(self, action: int) -> tuple[Pixels, float, bool, bool, dict[str, Any]]:
        """Hold the action for `tics` tics, fewer at the end of the episode."""
        self._count_turn(action)
        held = min(self._tics, LIMIT - self._lived)
        reward = float(self._game.make_action(BUTTONS[action], held))
        self._lived += held
        died = bool(self._game.is_episode_finished())
        info = {FAR_TURNS: self._far_turns / self._turns} if self._turns else {}
        return self._observe(), reward, died, not died and self._lived >= LIMIT, info

    def render(self) -> Any:
        """The last picture."""
        return self._picture

    def close(self) -> None:
        """End the game's process."""
        if self._game is not None:
            self._game.close()
            self._game = None

    def _count_turn(self, action: int) -> None:
        """Count a turn where the player goes the other way than last."""
        if action == STAY:
            return
        if self._direction not in (STAY, action):
            side = self._game.get_game_variable(self._vizdoom.GameVariable.POSITION_Y)
            self._turns += 1
            self._far_turns += min(abs(side - wall) for wall in WALLS) > FAR
        self._direction = action

    def _observe(self) -> Pixels:
        if (state := self._game.get_state()) is not None:
            self._picture = state.screen_buffer
            if self._labelled:
                balls = [each.value for each in state.labels if each.object_name == FIREBALL]
                self.fireballs = np.isin(state.labels_buffer, balls)
        return self._picture

    def _start(self) -> Any:
        vizdoom = self._vizdoom
        game = vizdoom.DoomGame()
        game.load_config(str(Path(vizdoom.scenarios_path) / "take_cover.cfg"))
        game.set_doom_skill(SKILL)
        game.set_living_reward(1)
        game.set_window_visible(False)
        sizes = vizdoom.ScreenResolution
        game.set_screen_resolution(sizes.RES_640X480 if self._screen else sizes.RES_160X120)
        game.set_screen_format(vizdoom.ScreenFormat.RGB24)
        game.set_render_hud(self._screen)
        game.set_labels_buffer_enabled(self._labelled)
        game.set_render_screen_flashes(self._screen)  # red after a hit
        start_game(game, Path(vizdoom.__file__).with_name("vizdoom"))
        return game


def observe_band(picture: Pixels) -> Floats:
    """Brightness from 0 to 1 in 4 x 32 cells of the rows at the height of the eyes, `(128,)`."""
    height, width = CELL
    band = picture[FIRST_ROW : FIRST_ROW + ROWS * height].reshape(ROWS, height, COLUMNS, width, 3)
    sums = band.sum(axis=(1, 3, 4), dtype=np.int64).reshape(-1)  # whole numbers: the same bits on every host
    brightness: Floats = (sums / (255 * 3 * height * width)).astype(np.float32)
    return brightness
