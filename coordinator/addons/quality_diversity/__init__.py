"""Many kinds of behaviour: optimisers that keep an archive, and its picture."""
