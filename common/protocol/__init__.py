"""What travels over Zenoh: keys, messages, their encoding and bounds."""
