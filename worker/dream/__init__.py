"""Worlds as their MDN-RNN predicts them: a task to evolve controllers in, and gymnasium environments.

Importing this registers `dreamfleet/Dream-v0` for the world of any bundle, also for `gymnasium.make_vec`.
`dreamfleet/CarRacingDream-v0` is the same by its first name.

>>> import gymnasium, dreamfleet.worker.dream
>>> environment = gymnasium.make("dreamfleet/Dream-v0", bundle="tiny", temperature=1.2)
>>> environment.metadata["render_fps"]
50

Pages: dreams.md, dreams-notes.md, tasks.md, worlds.md, determinism.md.
"""

from __future__ import annotations

import gymnasium

__all__ = ["task", "world", "batch", "environment", "noise"]

ENVIRONMENT, CAR_RACING_ENVIRONMENT = "dreamfleet/Dream-v0", "dreamfleet/CarRacingDream-v0"

for _name in (ENVIRONMENT, CAR_RACING_ENVIRONMENT):
    gymnasium.register(
        id=_name,
        entry_point="dreamfleet.worker.dream.environment:Dream",
        vector_entry_point="dreamfleet.worker.dream.environment:VectorDream",
        kwargs={"bundle": "tiny"},
    )
