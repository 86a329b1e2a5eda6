"""The covariance of the force, compiled: for loops that have microseconds."""
