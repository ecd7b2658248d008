"""A look into a world model: what it sees, forgets and dreams, as one page."""
