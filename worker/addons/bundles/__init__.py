"""Bundles taken apart, or rounded to eight bits."""
