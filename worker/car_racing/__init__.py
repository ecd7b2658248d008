"""CarRacing with gymnasium's own physics and a native picture of it, equal to the bit.

Importing this registers `dreamfleet/CarRacing-v3`, as gymnasium's packages of environments do.

>>> import gymnasium, dreamfleet.worker.car_racing
>>> environment = gymnasium.make("dreamfleet/CarRacing-v3")
"""

from __future__ import annotations

import gymnasium

ENVIRONMENT = "dreamfleet/CarRacing-v3"

gymnasium.register(
    id=ENVIRONMENT,
    entry_point="dreamfleet.worker.car_racing.environment:CarRacing",
    max_episode_steps=1000,
    reward_threshold=900,
)
