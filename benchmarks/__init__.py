"""Times, each beside its competitor in the same run, and the long computations behind quoted figures."""
