"""What the rows of a journal say together."""
