"""One life of a run: ask, dispatch, journal, tell."""
