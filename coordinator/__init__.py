"""Everything that decides: evolution, dispatch, journal, status. Never torch, never a simulator."""
