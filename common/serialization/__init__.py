"""Plain data to typed objects and back: validation, bounded values, fields that later versions added."""
