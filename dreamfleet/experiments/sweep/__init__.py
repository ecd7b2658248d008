"""Many runs that differ in a few settings, on one fleet."""

__all__ = ["display", "runner", "figure", "folder", "summary", "plan"]
