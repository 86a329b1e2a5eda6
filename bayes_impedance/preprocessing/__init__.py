"""From raw samples to trials and repetitions of smoothed motion and force on an even grid, with phase."""

from bayes_impedance.preprocessing.prepare import prepare as prepare
from bayes_impedance.preprocessing.prepared import PreparedLog as PreparedLog
from bayes_impedance.preprocessing.prepared import PreparedTrial as PreparedTrial
from bayes_impedance.preprocessing.segmentation import segment as segment
