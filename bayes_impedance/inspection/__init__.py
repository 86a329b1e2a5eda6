"""What is in a recording, what looks wrong with it, and the configuration that would read it."""
