"""The baselines by name."""

RANDOM, DISCRETE, DRQN = NAMES = ("random", "random-discrete", "drqn")
