"""Measurements that are ratios from one run: cases take turns in blocks, medians count.

Pages: measurements.md, gpu.md.
"""

__all__ = ["verb"]
