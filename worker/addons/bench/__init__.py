"""Measurements that are ratios from one run: cases take turns in blocks, medians count.

Its pages: docs/lab/measurements.md, docs/how-to/gpu.md.
"""

__all__ = ["verb"]
