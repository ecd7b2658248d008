"""Optimisers of a third party, for tests."""

import json
from typing import ClassVar

import numpy as np


class ParentsAndChildren:
    """A (mu, lambda) evolution strategy whose step size shrinks by one percent a generation."""

    requirement = "parents-and-children==1.0"
    options: ClassVar = {"parents": "how many of the candidates the next mean is made of"}

    def __init__(self, search):
        self._search, self.mean, self.sigma = search, search.mean, search.sigma0
        self._parents = int(search.options.get("parents", search.population // 2))
        self._random = np.random.default_rng(search.seed)

    def ask(self):
        steps = self._random.standard_normal((self._search.population, self._search.dimension))
        self._asked = self.mean + self.sigma * steps
        return self._asked

    def tell(self, fitness):
        self.mean = self._asked[np.argsort(-fitness, kind="stable")[: self._parents]].mean(axis=0)
        self.sigma *= 0.99

    def prepare(self):
        pass

    def state(self):
        random = json.dumps(self._random.bit_generator.state)
        return {"mean": self.mean, "sigma": np.array(self.sigma), "random": np.array(random)}

    def restore(self, state):
        self.mean, self.sigma = state["mean"], float(state["sigma"])
        self._random.bit_generator.state = json.loads(str(state["random"]))


class WithoutState(ParentsAndChildren):
    state = property()  # raises AttributeError, as if missing


class KeepsObjects(ParentsAndChildren):
    def state(self):
        return {"mean": np.array([self], dtype=object)}


class AsksForTooMany(ParentsAndChildren):
    def ask(self):
        return np.zeros((self._search.population + 1, self._search.dimension))


class Diverged(ParentsAndChildren):
    def ask(self):
        return np.full((self._search.population, self._search.dimension), np.nan)


class BuiltFromNothing(ParentsAndChildren):
    def __init__(self):
        pass


class SaysNothing:
    def __init__(self, search):
        pass
