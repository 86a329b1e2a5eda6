"""Inside a control loop: a model that learns every sample and predicts the next force within a millisecond."""

from bayes_impedance.online.predictor import OnlinePredictor as OnlinePredictor
from bayes_impedance.online.predictor import Prediction as Prediction
from bayes_impedance.online.sample import Sample as Sample
