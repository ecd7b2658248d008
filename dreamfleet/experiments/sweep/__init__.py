"""Many runs that differ in a few settings, on one fleet.

Its pages: docs/how-to/sweep.md.
"""

__all__ = ["display", "runner", "figure", "folder", "summary", "plan"]
