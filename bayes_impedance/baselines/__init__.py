"""What people use otherwise, on the same log."""
