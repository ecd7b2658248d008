"""The example script that trains an agent in the dream runs to its end and holds choices."""

import os
import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location

import gymnasium
import numpy as np
import pytest

from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.processes import DEADLINE, ROOT

SCRIPT = ROOT / "docs" / "tutorials" / "own_agent.py"


@pytest.fixture
def small(tmp_path):
    eyes, memory = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
    return write_random_bundle(tmp_path / "small.zip", vae=eyes, rnn=memory)


@pytest.mark.slow
def test_it_learns_in_the_dream_and_is_judged_on_real_tracks(small):
    words = (sys.executable, SCRIPT, "--steps", "12000", "--episodes", "1", "--bundle", small.path)
    one = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, env=one, capture_output=True, text=True, timeout=DEADLINE, check=False)
    assert done.returncode == 0, done.stderr
    learning, learnt, random = done.stdout.splitlines()
    assert learning.startswith("11776 steps, ")
    for name, line in ("learnt", learnt), ("random", random):
        assert re.fullmatch(rf"{name}: -?\d+\.\d on one real track", line)


def test_a_choice_is_held_until_the_dream_ends_and_no_longer(small):
    spec = spec_from_file_location("own_agent", SCRIPT)
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    dreams, single = (
        gymnasium.make_vec(script.DREAM, 2, "vector_entry_point", bundle=small, features="zh", horizon=6)
        for _ in range(2)
    )
    dreams.reset(seed=1)
    single.reset(seed=1)
    steps = [single.step(script.ACTIONS[[1, 3]]) for _ in range(8)]
    first, second = (script.hold(dreams, np.array([1, 3])) for _ in range(2))
    assert not first.over.any()
    assert second.over.all()
    assert not (second.failed | second.last).any()
    for held, played, after, now in ((first, steps[:4], 3, 3), (second, steps[4:6], 5, 7)):
        assert np.array_equal(held.reward, sum(step[1] for step in played))
        assert np.array_equal(held.after, steps[after][0])
        assert np.array_equal(held.now, steps[now][0])
