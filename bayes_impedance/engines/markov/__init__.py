"""Inference given impedance in a time that grows with the number of samples, for Matérn processes over one θ."""

from bayes_impedance.engines.markov.engine import MarkovEngine as MarkovEngine
from bayes_impedance.engines.markov.engine import unsupported as unsupported
