"""Figures: force against prediction, desired against actual trajectory, impedance prior and posterior, a plan.

Each function returns a matplotlib figure and shows nothing by itself. Every impedance curve carries its
verdict, so that no stiffness is looked at without it.
"""

from bayes_impedance.plotting.ellipses import plot_ellipses as plot_ellipses
from bayes_impedance.plotting.files import save_figures as save_figures
from bayes_impedance.plotting.impedance import plot_impedance as plot_impedance
from bayes_impedance.plotting.over_time import plot_desired_trajectory as plot_desired_trajectory
from bayes_impedance.plotting.over_time import plot_force as plot_force
from bayes_impedance.plotting.panels import save_figure as save_figure
from bayes_impedance.plotting.plans import plot_plan as plot_plan
from bayes_impedance.plotting.recordings import plot_recording as plot_recording
