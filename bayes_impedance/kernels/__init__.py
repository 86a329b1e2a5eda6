"""Covariances of the interaction force, as ordinary gpytorch kernels."""

from bayes_impedance.kernels.coupled import CoupledImpedanceKernel as CoupledImpedanceKernel
from bayes_impedance.kernels.coupled import CoupledInteractionKernel as CoupledInteractionKernel
from bayes_impedance.kernels.coupled_terms import CoupledProcess as CoupledProcess
from bayes_impedance.kernels.impedance import ImpedanceKernel as ImpedanceKernel
from bayes_impedance.kernels.impedance import InputLayout as InputLayout
from bayes_impedance.kernels.impedance import InteractionKernel as InteractionKernel
from bayes_impedance.kernels.impedance import InteractionMean as InteractionMean
from bayes_impedance.kernels.impedance import Latent as Latent
from bayes_impedance.kernels.impedance import PDKernel as PDKernel
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel as MotionNoiseKernel
from bayes_impedance.kernels.stationary import StationaryKernel as StationaryKernel
from bayes_impedance.kernels.warped import ImpedanceProcess as ImpedanceProcess
