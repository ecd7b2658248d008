"""The Zenoh protocol: keys, messages, their encoding and their bounds."""
