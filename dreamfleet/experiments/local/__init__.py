"""What experiments stand on: processes of this host and their command lines, names of functions, kept documents."""

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
