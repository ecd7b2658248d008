"""Finished and live runs compared, plotted, exported and cited."""
