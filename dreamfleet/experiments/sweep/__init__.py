"""Many runs that differ in a few settings, on one fleet. Pages: sweep.md."""

__all__ = ["display", "runner", "figure", "folder", "summary", "plan"]
