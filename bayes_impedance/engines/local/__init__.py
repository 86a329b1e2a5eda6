"""Local sparse models: cells of a grid that learn sample by sample."""
