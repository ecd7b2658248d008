"""What can be scored in: each task is an environment and what a controller sees of it and may do."""
