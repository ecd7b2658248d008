"""CarRacing as the MDN-RNN predicts it: a task to evolve controllers in, and gymnasium environments.

Importing this registers `dreamfleet/CarRacingDream-v0`, also for `gymnasium.make_vec`.

>>> import gymnasium, dreamfleet.worker.dream
>>> environment = gymnasium.make("dreamfleet/CarRacingDream-v0")
"""

from __future__ import annotations

import gymnasium

ENVIRONMENT = "dreamfleet/CarRacingDream-v0"

gymnasium.register(
    id=ENVIRONMENT,
    entry_point="dreamfleet.worker.dream.environment:CarRacingDream",
    vector_entry_point="dreamfleet.worker.dream.environment:CarRacingDreamVector",
    kwargs={"bundle": "tiny"},
)
