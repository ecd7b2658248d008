"""Asking live runs from any host: status, batches, frames, and what follows from them."""
