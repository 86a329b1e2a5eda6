"""`python -m bayes_impedance` is the command line."""

from bayes_impedance.cli import main

main()
