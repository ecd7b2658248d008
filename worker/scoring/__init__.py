"""Scoring candidates, with one episode loop for scoring, evaluating, recording and collecting."""
