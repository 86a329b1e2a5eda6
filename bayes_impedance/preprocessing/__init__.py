"""From raw samples to smoothed motion and force on an even grid."""

from bayes_impedance.preprocessing.prepare import prepare as prepare
from bayes_impedance.preprocessing.prepared import PreparedLog as PreparedLog
from bayes_impedance.preprocessing.prepared import PreparedTrial as PreparedTrial
