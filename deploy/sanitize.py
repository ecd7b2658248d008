"""Drive the native renderer under AddressSanitizer with extreme actions; `make sanitize` builds it.

python sanitize.py MODULE STEPS
"""

from __future__ import annotations

import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location

NAME = "dreamfleet.worker.worlds.car_racing._native"


def use(path: str) -> None:
    """Make the environment use the renderer at `path`."""
    loader = ExtensionFileLoader(NAME, path)
    spec = spec_from_file_location(NAME, path, loader=loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    sys.modules[NAME] = module


def wild(random):
    """Actions far beyond the action space, sometimes held, sometimes random."""
    size = random.choice([0.0, 1.0, 3.0, 1e3, 1e30])
    return lambda: random.choice([-size, size, random.uniform(-1, 1)], 3)


def drive(steps: int) -> None:
    """Make `steps` environment steps; episodes continue for a while after the car leaves the field."""
    import numpy as np

    from dreamfleet.worker.worlds.car_racing.environment import CarRacing, _native

    random = np.random.default_rng(0)
    kinds = ("raw-96", "raw-96", "box-64")
    environments = [CarRacing(domain_randomize=bool(i % 2), preprocessing=kind) for i, kind in enumerate(kinds)]
    done = episode = 0
    while done < steps:
        environment = environments[episode % 3]
        _native.widen(episode // 3 % 3)
        environment.reset(seed=episode)
        environment.t = random.uniform(0, 1.5)
        act = wild(random)
        for step in range(int(random.integers(1, 2000))):
            if step % 50 == 0:
                act = wild(random)
                if random.random() < 0.3:
                    hull = environment.car.hull
                    environment.place(hull.angle + random.choice([0.0, 0.5, np.pi / 2]), *hull.position)
            environment.step(act())
            done += 1
        episode += 1
        if episode % 20 == 0:
            print(f"{done} steps", flush=True)
    print(f"{done} steps in {episode} episodes: nothing found")


if __name__ == "__main__":
    use(sys.argv[1])
    drive(int(sys.argv[2]))
