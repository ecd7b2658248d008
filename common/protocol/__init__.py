"""The Zenoh protocol: keys, messages, their encoding and bounds; tasks' names, measures, host classes, failures.

Pages: protocol.md, glossary.md.
"""

__all__ = [
    "keys",
    "messages",
    "codec",
    "tasks",
    "batches",
    "measures",
    "host_classes",
    "result_bounds",
    "failures",
    "stop_kind",
    "check_counts",
    "frame_pictures",
    "function_values",
]
