"""What a recording needs before it is an interaction log: one clock, force in one frame without its tool, checks."""
