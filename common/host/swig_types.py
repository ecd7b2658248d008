"""Warnings that native modules made by SWIG, such as Box2D, raise as they are imported."""

from __future__ import annotations

import warnings


def allow_swig_types() -> None:
    """Ignore them from now on: where warnings are errors, such a module ends the process (SIGSEGV)."""
    warnings.filterwarnings("ignore", r"builtin type [sS]wig\w* has no __module__", DeprecationWarning)
