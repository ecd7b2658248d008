"""Scoring candidates: one episode loop for all who drive one."""
