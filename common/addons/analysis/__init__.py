"""What runs and their curves have in common: charts, comparison, learning."""
