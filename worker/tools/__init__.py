"""Tools for people: evaluate, record, watch and replay a controller."""
