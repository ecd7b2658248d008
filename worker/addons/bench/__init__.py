"""Measurements that are ratios from one run: cases take turns in blocks, medians count."""

__all__ = ["verb"]
