"""What people do with a controller: judge it, record it, score it again."""
