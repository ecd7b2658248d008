"""The words both sides speak: keys, messages, codec, configuration, bundle, controller, journal schema."""
