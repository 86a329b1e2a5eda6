"""Inference given impedance on features of the processes: Hilbert-space features, or Fourier's of a periodic phase."""

from bayes_impedance.engines.lowrank.columns import Design as Design
from bayes_impedance.engines.lowrank.engine import LowRankEngine as LowRankEngine
from bayes_impedance.engines.lowrank.hilbert import Accuracy as Accuracy
from bayes_impedance.engines.lowrank.support import unsupported as unsupported
