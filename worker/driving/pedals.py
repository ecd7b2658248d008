"""The keys that are held, as an action."""

from __future__ import annotations

import numpy as np
import pygame
from numpy.typing import NDArray

LEFT, RIGHT = (pygame.K_LEFT, pygame.K_a), (pygame.K_RIGHT, pygame.K_d)
GAS, BRAKE = (pygame.K_UP, pygame.K_w), (pygame.K_DOWN, pygame.K_s)
BRAKE_STRENGTH = 0.8  # gymnasium's own keyboard: at 1 the wheels lock


class Pedals:
    """Steering, gas and brake by the arrows or WASD."""

    def __init__(self) -> None:
        self._held: set[int] = set()

    def handle_event(self, event: pygame.event.Event) -> None:
        """A key goes down or up; with the window's focus go all of them, for nobody tells of those let go elsewhere."""
        if event.type == pygame.KEYDOWN:
            self._held.add(event.key)
        elif event.type == pygame.KEYUP:
            self._held.discard(event.key)
        elif event.type == pygame.WINDOWFOCUSLOST:
            self._held.clear()

    def action(self) -> NDArray[np.float32]:
        """Steering in [-1, 1], gas, brake in [0, 1] `(3,)`; left and right together steer nowhere."""
        left, right, gas, brake = (not self._held.isdisjoint(keys) for keys in (LEFT, RIGHT, GAS, BRAKE))
        return np.array([int(right) - int(left), gas, BRAKE_STRENGTH * brake], dtype=np.float32)
