"""What experiments stand on: processes of this host, their command lines, kept documents, arguments of searches.

Pages: python.md.
"""

__all__ = [
    "local_run",
    "command_lines",
    "isolated",
    "kept_document",
    "kept_words",
    "function_names",
    "run_arguments",
    "search_arguments",
]
