"""Commands that have a file of their own; the command line registers them."""
