"""CarRacing in native code, equal to gymnasium's to the bit: one with its picture, one seen through a frozen encoder.

Importing this registers `dreamfleet/CarRacing-v3` and `dreamfleet/CarRacingLatent-v0` with gymnasium.

>>> import gymnasium, dreamfleet.worker.worlds.car_racing
>>> environment = gymnasium.make("dreamfleet/CarRacing-v3")

Pages: tasks.md, sources.md, operations-notes.md.
"""

from __future__ import annotations

import gymnasium

from dreamfleet.common.host.packages import allow_swig_types

__all__ = ["task", "agents", "environment", "preprocessing", "native_check"]

ENVIRONMENT = "dreamfleet/CarRacing-v3"
LATENT = "dreamfleet/CarRacingLatent-v0"

allow_swig_types()  # for Box2D, if it is imported
gymnasium.register(
    id=ENVIRONMENT,
    entry_point="dreamfleet.worker.worlds.car_racing.native_check:make_unwrapped",
    max_episode_steps=1000,
    reward_threshold=900,
)
gymnasium.register(
    id=LATENT,
    entry_point="dreamfleet.worker.worlds.car_racing.latent:CarRacingLatent",
    reward_threshold=900,
    kwargs={"bundle": "tiny"},
)
