"""An observer of steps, as a viewer's sampler is one."""


class Watching(list):
    """The observed steps, each with its episode: all, or one of `every`."""

    def __init__(self, every=1):
        super().__init__()
        self._every, self._asked = every, 0

    def is_due(self):
        self._asked += 1
        return self._asked % self._every == 0

    def observe(self, episode, look):
        self.append((episode, look()))
