"""A worker as a service: joins a run, scores what it is given, delivers until acknowledged."""
