"""Workers on other hosts, by one command: over the system's ssh, each into a folder of its own there."""
